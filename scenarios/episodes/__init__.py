"""One episode: wiring of engines, scoring, replay, comparison and demonstrations."""
