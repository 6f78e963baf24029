"""The functions behind `import abbe`: thin, typed, in the units of the package, on the same code as the commands."""
