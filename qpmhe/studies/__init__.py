"""Scripted studies: the paper's example first."""

from .paper import IpoptComparison, PaperStudy, Row, backend_rows, ipopt_rows, paper_rows

__all__ = ["IpoptComparison", "PaperStudy", "Row", "backend_rows", "ipopt_rows", "paper_rows"]
