"""Every sky in five scenes: whether edited maps are still photographs of skies."""
