"""The 3-axis kinematic chain, which turns error motions into a deviation of the tool."""
