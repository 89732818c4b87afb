"""Scripted studies: grids of estimators with their results, and the paper's example."""

from .grid import Study
from .paper import IpoptComparison, PaperStudy, Row, backend_rows, ipopt_rows, paper_rows
from .qpbenchmark_set import ExportedSet, export_qpbenchmark
from .report import write_report
from .runner import run
from .store import Store
from .summary import summarise
from .table_file import export

__all__ = [
    "ExportedSet",
    "IpoptComparison",
    "PaperStudy",
    "Row",
    "Store",
    "Study",
    "backend_rows",
    "export",
    "export_qpbenchmark",
    "ipopt_rows",
    "paper_rows",
    "run",
    "summarise",
    "write_report",
]
