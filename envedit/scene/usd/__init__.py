"""USD files as Mitsuba scenes: what is read of them, and the process that reads them."""
