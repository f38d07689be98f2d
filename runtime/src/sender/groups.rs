//! The groups of an application, and its retained values in them.

use super::{SendError, Sender};
use crate::{
    tid::AppAddress,
    wire::{Message, Payload},
};

#[cfg(doc)]
use crate::tid::Tid;

impl Sender {
    /// Adds this application to the group called `name`: it receives messages to [`Tid::group`]. A name that
    /// breaks the grammar of [names](crate::name) is rejected with an error in the log.
    pub fn join(&self, name: &str) {
        if let Err(why) = crate::name::check_name(name) {
            let group: String = name.escape_debug().take(crate::name::NAME_BYTES_MAX).collect();
            crate::log::error!(%group, %why, "the group is not joined: its name cannot be used");
            return;
        }
        self.set_member(name, true);
    }

    /// Removes this application from the group called `name`.
    pub fn leave(&self, name: &str) {
        self.set_member(name, false);
    }

    fn set_member(&self, name: &str, member: bool) {
        if !self.is_over() {
            self.shared.directory.set_member(self.shared.tid.app, AppAddress::group(name), member);
        }
    }

    /// Removes the value of type `P` that this application's node retains for later members of the group called
    /// `name`, on every node. Has no effect if there is none.
    ///
    /// # Errors
    /// No queue and no socket accepted the message.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{message::{SendError, Sender}, payload};
    ///
    /// payload!("demo.map", Bulk, retained => struct Map { cells: Vec<u8> });
    ///
    /// /// The robot was carried elsewhere: no later member gets the map of the former place.
    /// fn forget_the_map(sender: &Sender) -> Result<(), SendError> {
    ///     sender.clear_retained::<Map>("map")
    /// }
    /// ```
    pub fn clear_retained<P: Payload>(&self, name: &str) -> Result<(), SendError> {
        self.dispatch(Message::clear_retained::<P>(self.shared.tid, AppAddress::group(name))).map(drop)
    }
}
