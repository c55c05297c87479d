"""Which measurement tells rival explanations apart."""
