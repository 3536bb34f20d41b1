"""The paper's studies: settings as data, and one runner for their jobs."""
