"""Pictures, films, reports and recordings of episodes."""
