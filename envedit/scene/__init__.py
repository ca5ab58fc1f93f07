"""A Mitsuba scene with one replaceable environment map."""
