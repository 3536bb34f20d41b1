"""Studies of the paper and further ones: settings as data, and one runner for all jobs."""
