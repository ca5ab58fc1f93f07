"""Many skies in many scenes: are edited maps still photographs of skies?"""
