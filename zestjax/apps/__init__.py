"""What the commands do: loops, files and progress around the pure core."""
