"""What a posterior is for: watch the physical twin, foresee it, ask what would have been."""
