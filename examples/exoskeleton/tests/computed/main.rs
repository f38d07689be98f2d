//! Tests that compute and do not wait: one binary, which is linked once.

mod foxglove_layout;
mod lockstep;
mod output;
mod topology;
mod virtual_time;
