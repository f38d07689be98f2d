//! The model as a user sees it. One binary, which is linked once; one module for each part.

mod central;
mod drive;
mod golden;
mod trial_reader;
