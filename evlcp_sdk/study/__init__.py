"""What was received beside what was sent: truth, score, comparison, campaigns."""
