"""Which effect: scores of all candidates, refits of the best, the search for sets, confirmation by an engine."""
