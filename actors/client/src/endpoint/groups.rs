//! The groups of an endpoint.

use std::pin::pin;

use sinew_protocol::payload::{self, Group};
use sinew_runtime::{
    name::{NAME_BYTES_MAX, check_name},
    outcome::{Outcome, Rejection},
    tid::AppAddress,
    wire::{Flags, Kind, Message, Payload},
};

use super::{Endpoint, LNCL, PROMPT};
use crate::{
    ApiError,
    inbox::{Answer, Awaited},
    wait_mode::block_ready,
};

#[cfg(doc)]
use sinew_runtime::tid::Tid;

impl Endpoint {
    /// Joins the group called `name`: from now on messages to [`Tid::group`] reach this endpoint.
    ///
    /// # Errors
    /// The endpoint is a member of 256 groups already, or its user or node has the maximum of memberships
    /// ([`ApiError::TooManyGroups`]); the node's access list does not allow its user to join this group
    /// ([`ApiError::Ended`], `NotAllowed`); or the node did not answer.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Endpoint, client::ApiError};
    ///
    /// /// From now on messages to `Tid::group("drives")` come here, too.
    /// fn join_drives(endpoint: &mut Endpoint) -> Result<(), ApiError> {
    ///     endpoint.join("drives")
    /// }
    /// ```
    pub fn join(&mut self, name: &str) -> Result<(), ApiError> {
        block_ready(pin!(self.set_member(group_named(name)?, true)))
    }

    /// Leaves the group called `name`.
    ///
    /// # Errors
    /// The node did not answer.
    pub fn leave(&mut self, name: &str) -> Result<(), ApiError> {
        block_ready(pin!(self.set_member(AppAddress::group(name), false)))
    }

    /// Removes the value of type `P` that the node retains for later members of the group called `name`. Has no effect
    /// if there is none.
    ///
    /// # Errors
    /// The node does not accept the message.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Endpoint, client::ApiError, payload};
    ///
    /// payload!("demo.mode", retained => struct Mode { is_walking: bool });
    ///
    /// fn forget_the_mode(endpoint: &mut Endpoint) -> Result<(), ApiError> {
    ///     endpoint.clear_retained::<Mode>("mode")
    /// }
    /// ```
    pub fn clear_retained<P: Payload>(&mut self, name: &str) -> Result<(), ApiError> {
        block_ready(pin!(self.send_clear::<P>(name)))
    }

    pub(crate) async fn send_clear<P: Payload>(&mut self, name: &str) -> Result<(), ApiError> {
        let message = Message::clear_retained::<P>(self.tid, group_named(name)?);
        self.dispatch(message.into(), self.stall_timeout()).await.map(drop)
    }

    pub(crate) async fn set_member(&mut self, group: AppAddress, member: bool) -> Result<(), ApiError> {
        let message = payload::frame(Kind::LNCL_GROUP, self.tid, LNCL, &Group { group, member });
        match self.request(message.into(), Awaited::Outcome, Flags::CONFIRM, PROMPT).await? {
            Some(Answer::Outcome(Outcome::Delivered)) => {
                if member {
                    self.reconnect.groups.insert(group);
                } else {
                    self.reconnect.groups.remove(&group);
                }
                Ok(())
            }
            Some(Answer::Outcome(Outcome::Rejected(Rejection::QueueFull))) => Err(ApiError::TooManyGroups),
            Some(Answer::Outcome(outcome)) => Err(ApiError::Ended(outcome)),
            Some(Answer::Members(_) | Answer::Reply(_) | Answer::Resolved(..)) | None => {
                Err(ApiError::NoAnswer(PROMPT))
            }
        }
    }
}

/// Returns the address of the group of this name.
///
/// # Errors
/// The name breaks the grammar of names.
pub(crate) fn group_named(name: &str) -> Result<AppAddress, ApiError> {
    let beginning = || name.chars().take(NAME_BYTES_MAX).collect();
    check_name(name).map_err(|why| ApiError::BadName { name: beginning(), why })?;
    Ok(AppAddress::group(name))
}
