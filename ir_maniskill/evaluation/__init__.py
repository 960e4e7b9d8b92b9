"""What a learned policy does: figures with intervals, films, learning curves."""
