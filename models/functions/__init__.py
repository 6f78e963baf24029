"""Error motions as functions of one axis position: polynomial, Legendre, B-spline, table."""
