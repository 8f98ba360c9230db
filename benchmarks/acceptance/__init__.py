"""Is it right? Many random questions, each against another method."""
