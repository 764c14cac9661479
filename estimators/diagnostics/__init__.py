"""What a track was worth: health, scores, calibration, causes of failure, pictures of a field."""
