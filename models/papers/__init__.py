"""The papers that the product rests on: their equations and experiments as printed."""
