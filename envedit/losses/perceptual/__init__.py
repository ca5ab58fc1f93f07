"""DISTS and LPIPS, with network weights from the user's files."""
