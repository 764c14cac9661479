"""What a track was worth: health, scores, causes of failure, pictures of a field."""
