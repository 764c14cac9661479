"""Workbooks of Excel and OpenDocument as tables, read by calamine."""

from config.extensions import Extension, Part

EXTENSION = Extension(tables=dict.fromkeys((".xlsx", ".xls", ".ods"), Part("", f"{__name__}.workbook:WORKBOOK")))
