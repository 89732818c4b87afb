"""Reports of studies: a page with answers, figures and tables, and static figures."""

from .answers import Answer, Case, cases
from .page import write_report

__all__ = ["Answer", "Case", "cases", "write_report"]
