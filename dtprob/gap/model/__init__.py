"""A declared model on data as functions of one flat vector, compiled, with derivatives at its sites."""
