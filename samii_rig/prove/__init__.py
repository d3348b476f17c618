"""The proof: concealed trials, diagnosed without the truth, then scored against it."""
