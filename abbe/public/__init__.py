"""The functions behind `import abbe`: thin, typed wrappers of the code that the commands use."""
