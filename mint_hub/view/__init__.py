"""Episodes made visible: overlay videos, plots, and interactive scenes."""
