//! The picture of a run as SVG, written by hand.
