"""Speed against accuracy: what each setting costs and what it is worth, beside the standard preset."""
