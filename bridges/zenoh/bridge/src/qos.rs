//! Classes as priorities, reliability and congestion control of Zenoh.
//!
//! | class | priority | reliability | full queue | express |
//! | --- | --- | --- | --- | --- |
//! | Control | RealTime | reliable | blocks | yes |
//! | Stream | InteractiveHigh | best effort | drops | yes |
//! | Bulk | Background | reliable | blocks | no |

use sinew::message::Class;

/// A priority of Zenoh, with the number that the protocol gives it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Priority {
    /// Before all others.
    RealTime = 1,
    /// Behind `RealTime`.
    InteractiveHigh = 2,
    /// Behind all others.
    Background = 7,
}

/// The settings of a put.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Qos {
    /// The priority.
    pub priority: Priority,
    /// Whether it is sent again where a link can lose it.
    pub is_reliable: bool,
    /// Whether a full queue of Zenoh blocks the sender; otherwise it drops the message.
    pub blocks: bool,
    /// Whether it is not kept back for a batch.
    pub is_express: bool,
}

impl Qos {
    /// Returns the settings for a class.
    #[must_use]
    pub const fn of(class: Class) -> Self {
        match class {
            Class::Control => {
                Self { priority: Priority::RealTime, is_reliable: true, blocks: true, is_express: true }
            }
            Class::Stream => Self {
                priority: Priority::InteractiveHigh,
                is_reliable: false,
                blocks: false,
                is_express: true,
            },
            Class::Bulk => {
                Self { priority: Priority::Background, is_reliable: true, blocks: true, is_express: false }
            }
        }
    }
}
