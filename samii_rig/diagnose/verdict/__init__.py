"""From explanations to an answer: probabilities, places, what could hide, the next experiment."""
