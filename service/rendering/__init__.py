"""Rendering of a `document.Document` as self-contained HTML, PDF, CSV or JSON."""
