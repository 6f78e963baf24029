"""The papers on which Abbe rests: their equations and experiments, with errata; printed forms are named ``..._printed``."""
