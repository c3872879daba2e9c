"""What cameras see while an episode is recorded."""
