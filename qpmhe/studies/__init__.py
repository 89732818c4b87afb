"""Scripted studies: grids of estimators with their results, and the paper's example."""

from .export import export
from .grid import Study, StudyError
from .paper import PaperStudy, Reproduction, reproduce
from .qpbenchmark_set import ExportedSet, export_qpbenchmark
from .report import write_report
from .runner import run
from .store import Store, StoreError
from .summary import summarise

__all__ = [
    "ExportedSet", "PaperStudy", "Reproduction", "Store", "StoreError", "Study", "StudyError",
    "export", "export_qpbenchmark", "reproduce", "run", "summarise", "write_report",
]
