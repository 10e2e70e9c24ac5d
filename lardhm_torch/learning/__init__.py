"""What changes a map: clustering, weights, fine-tuning, updates by scans, merging of maps."""
