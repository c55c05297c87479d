"""How good diagnoses of withheld cases are: answers, truths, targets, rivals."""
