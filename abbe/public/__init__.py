"""The functions behind `import abbe`: thin, typed, in the units of the package; each calls what the commands call."""
