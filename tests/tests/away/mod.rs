//! Notifications of a death, and the handling of messages until the restart.

mod absence;
mod monitors;
mod requirements;
mod wills;
