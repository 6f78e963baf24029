"""Reports: a `document.Document` in, HTML, PDF, CSV and JSON out. Self-contained: no script, no request to anywhere."""
