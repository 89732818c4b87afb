"""Reports of studies: a page with answers, figures and tables, and static figures."""

from .answers import Answer, Case, cases
from .page import check_libraries, write_report

__all__ = ["Answer", "Case", "cases", "check_libraries", "write_report"]
