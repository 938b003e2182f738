"""What every report is made of: tables, intervals, provenance, progress."""
