"""`abbe papers`: every printed number of the four papers beside ours."""
