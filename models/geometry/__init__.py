"""Functions of axis position and the 3-axis chain that turns them into a deviation of the tool."""
