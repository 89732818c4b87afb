"""Reports of studies: a page with answers, figures and tables, and static figures."""

from .answers import Answer, Case, cases
from .write import Source, write_report

__all__ = ["Answer", "Case", "Source", "cases", "write_report"]
