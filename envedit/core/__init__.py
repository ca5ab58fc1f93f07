"""What everything stands on: errors, files, arrays, the texel grid, colour."""
