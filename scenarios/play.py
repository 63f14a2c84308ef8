"""Play: a capture of a real GPS receiver through transport, driver, database and localiser, unchanged."""
