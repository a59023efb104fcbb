"""Figures for print: native against scaled AbsRel of several submissions, as SVG and PNG."""
