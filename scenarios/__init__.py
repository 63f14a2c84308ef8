"""Runs the whole cart and judges it: scenario files, the runner, metrics, the `fairway` command."""
