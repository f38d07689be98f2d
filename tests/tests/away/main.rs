//! What others learn of a death, and what happens meanwhile. One binary, one module a theme.

mod absence;
mod monitors;
mod requirements;
mod wills;
