"""The page of a diagnosis: `page` puts together what `words`, `plots`, `models` and `laws` give."""
