"""Hardware abstraction: the signals that every package shares, codecs, drivers and device models of the cart."""
