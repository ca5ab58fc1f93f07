"""What the picture should be: under another light, painted, under strokes."""
