//! The log of messages that an application cannot use, at most one entry a second.

use std::{fmt, time::Duration};

use actix::Actor;

use super::AppContext;
use crate::{protection::ProtectionError, supervision::liveness::Liveness, tid::Tid, time::Time};

/// Time allowed for the first echo of a protected flow to reach its sender: one round trip on a machine that
/// starts many programs at once.
const OLD_AT_START: Duration = Duration::from_secs(1);

impl<A: Actor<Context = Self>> AppContext<A> {
    /// Logs a payload that could not be decoded.
    pub(in crate::app) fn warn_of_payload(&mut self, source: Tid, error: &dyn fmt::Display, now: Time) {
        self.warn_of_refusal(source, error, "build sender and receiver with the same type", now);
    }

    /// Logs a fault of a protected message.
    ///
    /// A sender that has not received its first echo sends messages that count as too old, briefly after each
    /// start. They are logged if they continue for [`OLD_AT_START`].
    pub(in crate::app) fn warn_of_fault(&mut self, source: Tid, fault: ProtectionError, now: Time) {
        let remedy = match fault {
            ProtectionError::TooOld => {
                let began = self
                    .old
                    .filter(|(_, last)| now.since(*last) < OLD_AT_START)
                    .map_or(now, |(began, _)| began);
                self.old = Some((began, now));
                if now.since(began) < OLD_AT_START {
                    return;
                }
                "see whether echoes reach its sender (an access list needs a rule for the way back), and how late messages are beside `age_max`"
            }
            ProtectionError::Corrupt => {
                "see whether both ends have the same type and TIDs, and what changes bytes between them"
            }
            ProtectionError::Unreadable => "build sender and receiver with the same type",
            ProtectionError::Repeated
            | ProtectionError::Backwards
            | ProtectionError::Restarted
            | ProtectionError::Gap => {
                "see what repeats, reorders or loses messages on the way, or whether the sender was restarted"
            }
        };
        self.warn_of_refusal(source, &fault, remedy, now);
    }

    /// Logs a rejected message, at most once a second: the mailbox counts all of them.
    pub(in crate::app) fn warn_of_refusal(
        &mut self,
        source: Tid,
        error: &dyn fmt::Display,
        remedy: &str,
        now: Time,
    ) {
        if self.warned.is_some_and(|last| now.since(last) < Duration::from_secs(1)) {
            self.unlogged += 1;
            return;
        }
        self.warned = Some(now);
        let suppressed = Some(std::mem::take(&mut self.unlogged)).filter(|count| *count > 0);
        let liveness = Liveness::current();
        let application = liveness.as_ref().map(|liveness| liveness.name());
        crate::log::warn!(
            application, tid = %self.tid(), %source, suppressed,
            "a message was refused: {error}; {remedy}"
        );
    }
}
