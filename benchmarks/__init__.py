"""What the project claims, measured: independent truths, acceptance, speed."""
