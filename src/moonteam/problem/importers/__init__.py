"""Other people's instances, read as problems by the clock; one file a format.

A format of one's own is an `Importer`, offered by an entry point in the group
`moonteam.importers` or as `FILE.py:OBJECT`.
"""

from moonteam.problem.importers.base import Importer
from moonteam.registry import Registry

IMPORTERS = Registry("format of instances", "moonteam.importers", Importer, {
    "dcmrta": "moonteam.problem.importers.dcmrta:IMPORTER",
    "heteromrta": "moonteam.problem.importers.heteromrta:IMPORTER",
    "mrta-benchmark": "moonteam.problem.importers.mrta_benchmark:IMPORTER"})

__all__ = ["IMPORTERS", "Importer"]
