"""Pictures and maps: read, checked, resized and written."""
