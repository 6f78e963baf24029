"""Files of instruments and tables of other programs: read strictly, previewed, and stored as campaigns."""
