"""Models held against records or lines: refits, the screen, the search, what is alike."""
