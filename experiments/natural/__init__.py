"""Many skies in many scenes: whether edited maps are still photographs of skies."""
