"""Results for eyes: pictures of episodes."""
