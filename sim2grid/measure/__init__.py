"""What a record says: metrics, slip, the story."""
