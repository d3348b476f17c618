"""What a person sees: plots, one HTML page, terminal summaries."""
