//! What a call came to: a number, a text for each number, and a sentence about this one case.

use std::{cell::RefCell, ffi::CStr, ffi::CString};

use sinew::client::ApiError;

use crate::words::text_of;

/// What a call came to. Negative: an error, and `sinew_last_error` has a sentence about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
#[allow(
    clippy::enum_variant_names,
    dead_code,
    reason = "these are the names in C, which has no other name spaces, and C may hand them back"
)]
pub enum Status {
    /// It is done.
    SinewOk = 0,
    /// No error, but nothing to hand out: no message came in time, or nobody has the name.
    SinewNothing = 1,
    /// An argument is NULL, no UTF-8, too long, or none of its legal values. Nothing was sent or registered.
    SinewErrorInvalidArgument = -1,
    /// No node listens at the path, or this user may not connect. Nothing was done.
    SinewErrorNoNode = -2,
    /// The node refused the registration, or a wait at a barrier, in words. Nothing is registered.
    SinewErrorRefused = -3,
    /// What is required was not ready at the deadline. Nothing is registered.
    SinewErrorWaiting = -4,
    /// The node did not answer in time. Whether it did what was asked is not known.
    SinewErrorNoAnswer = -5,
    /// The connection to the node has ended, and the registration with it: unregister, then register again.
    SinewErrorClosed = -6,
    /// There was no room in time: the node or, on a direct link, the receiver is stopped or too slow. Nothing of the message
    /// is received; it may be made and sent again.
    SinewErrorStalled = -7,
    /// The payload is longer than `sinew_payload_max`. Nothing was sent.
    SinewErrorTooLong = -8,
    /// A request was not handled, or a group not joined. The outcome and the sentence say why.
    SinewErrorNotHandled = -9,
    /// No reply came in time. The request may have been handled.
    SinewErrorNoReply = -10,
    /// The message asks for no reply. Nothing was sent.
    SinewErrorNotAsked = -11,
    /// What came is not what its kind says.
    SinewErrorMalformed = -12,
    /// This is no endpoint: it is NULL, or was unregistered, or never registered. Nothing was done.
    SinewErrorNoSuchEndpoint = -13,
    /// Another thread is in a call on this endpoint. Nothing was done.
    SinewErrorBusy = -14,
    /// This is no message of this endpoint: it was sent, discarded or settled already. Nothing was done.
    SinewErrorNoSuchMessage = -15,
    /// Too many endpoints in this process, or too many messages in hand. Nothing was sent or registered.
    SinewErrorTooMany = -16,
    /// The endpoint belongs to the process that this one was forked from. Nothing was done.
    SinewErrorForked = -17,
    /// A fault of this library. The endpoint can only be unregistered; all others go on.
    SinewErrorPanic = -18,
    /// A message is lent and was neither sent nor discarded: nothing else goes out of the endpoint before. Nothing was sent.
    SinewErrorLoanActive = -19,
    /// The connection to the node has ended, through no fault of this endpoint, which registers again by itself while it is
    /// used: go on. Each send without a time tries, and `sinew_receive_message`, which says this once, waits for it. The message
    /// was not sent.
    SinewErrorDisconnected = -20,
    /// Not all parties were at the barrier in time. The sentence says who is missing; the others go on waiting.
    SinewErrorNotMet = -21,
    /// A party of the barrier was lost, and was not to be waited for. The sentence says which.
    SinewErrorPartyLost = -22,
    /// This is no guard: it is NULL, or was released, or never made. Nothing was done.
    SinewErrorNoSuchGuard = -23,
    /// Too few good messages in a row have come, or the last one too long ago: the output cannot be armed yet. It stays safe.
    SinewErrorNotGood = -24,
    /// What makes the output safe says that it has failed: whether the output is safe is not known. It is called again each millisecond, until it has not.
    SinewErrorSafeFails = -25,
    /// What makes outputs safe in time cannot be started, or is not more urgent than the calling thread. No guard was made.
    SinewErrorNoWatchdog = -26,
}

impl Status {
    const ALL: [Self; 28] = [
        Self::SinewOk,
        Self::SinewNothing,
        Self::SinewErrorInvalidArgument,
        Self::SinewErrorNoNode,
        Self::SinewErrorRefused,
        Self::SinewErrorWaiting,
        Self::SinewErrorNoAnswer,
        Self::SinewErrorClosed,
        Self::SinewErrorStalled,
        Self::SinewErrorTooLong,
        Self::SinewErrorNotHandled,
        Self::SinewErrorNoReply,
        Self::SinewErrorNotAsked,
        Self::SinewErrorMalformed,
        Self::SinewErrorNoSuchEndpoint,
        Self::SinewErrorBusy,
        Self::SinewErrorNoSuchMessage,
        Self::SinewErrorTooMany,
        Self::SinewErrorForked,
        Self::SinewErrorPanic,
        Self::SinewErrorLoanActive,
        Self::SinewErrorDisconnected,
        Self::SinewErrorNotMet,
        Self::SinewErrorPartyLost,
        Self::SinewErrorNoSuchGuard,
        Self::SinewErrorNotGood,
        Self::SinewErrorSafeFails,
        Self::SinewErrorNoWatchdog,
    ];

    /// The text for a number; for one that is no status it says so.
    pub(crate) fn text_of(code: i32) -> &'static CStr {
        let status = Self::ALL.iter().find(|status| **status as i32 == code);
        status.map_or(c"no status of this library", |status| status.text())
    }

    const fn text(self) -> &'static CStr {
        match self {
            Self::SinewOk => c"done",
            Self::SinewNothing => c"nothing came, or nobody has the name",
            Self::SinewErrorInvalidArgument => {
                c"an argument is NULL, no UTF-8, too long, or none of its legal values"
            }
            Self::SinewErrorNoNode => {
                c"no node can be reached at this path; does it run, with this path as its `lncl.socket`?"
            }
            Self::SinewErrorRefused => c"the node refused the registration, or a wait at a barrier",
            Self::SinewErrorWaiting => c"what is required was not ready at the deadline",
            Self::SinewErrorNoAnswer => c"the node did not answer in time; does it hang?",
            Self::SinewErrorClosed => c"the connection to the node has ended; register again",
            Self::SinewErrorStalled => {
                c"no room in time: the node, or the receiver on a direct link, is stopped or too slow; it was not sent"
            },
            Self::SinewErrorTooLong => c"the payload is above the node's limit; raise `payload_max`",
            Self::SinewErrorNotHandled => c"it was not handled",
            Self::SinewErrorNoReply => c"no reply came in time",
            Self::SinewErrorNotAsked => c"the message asks for no reply",
            Self::SinewErrorMalformed => {
                c"what came is not what its kind says; do both sides use the same type?"
            }
            Self::SinewErrorNoSuchEndpoint => {
                c"this is no endpoint; is it NULL, was it unregistered, or never registered?"
            }
            Self::SinewErrorBusy => {
                c"another thread is in a call on this endpoint; register one endpoint for each thread"
            }
            Self::SinewErrorNoSuchMessage => {
                c"this is no message of this endpoint; was it sent, discarded or settled already?"
            }
            Self::SinewErrorTooMany => c"too many endpoints in this process, or too many messages in hand",
            Self::SinewErrorForked => {
                c"this endpoint belongs to the process that this one was forked from; register an own one"
            }
            Self::SinewErrorLoanActive => {
                c"a message of this endpoint is lent; hand it to sinew_send_message or sinew_discard_message first"
            }
            Self::SinewErrorDisconnected => {
                c"the connection to the node has ended; the endpoint registers again by itself while it is used"
            }
            Self::SinewErrorNotMet => c"not all were at the barrier in time",
            Self::SinewErrorPartyLost => c"a party of the barrier was lost",
            Self::SinewErrorNoSuchGuard => c"this is no guard; is it NULL, was it released, or never made?",
            Self::SinewErrorNotGood => {
                c"too few good messages in a row have come, or the last one too long ago, to arm the output"
            }
            Self::SinewErrorSafeFails => {
                c"what makes the output safe says that it has failed; it is called again each millisecond"
            }
            Self::SinewErrorNoWatchdog => {
                c"what makes outputs safe in time cannot be started, or is not more urgent than this thread"
            }
            Self::SinewErrorPanic => {
                c"a fault of this library; the endpoint can only be unregistered; please report it"
            }
        }
    }
}

/// Why a call failed.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Fault {
    pub(crate) status: Status,
    sentence: String,
}

impl Fault {
    pub(crate) fn new(status: Status, sentence: impl Into<String>) -> Self {
        Self { status, sentence: sentence.into() }
    }

    /// With the text of the number alone.
    pub(crate) fn plain(status: Status) -> Self {
        Self::new(status, status.text().to_string_lossy())
    }

    pub(crate) fn argument(sentence: impl Into<String>) -> Self {
        Self::new(Status::SinewErrorInvalidArgument, sentence)
    }

    /// Keeps the sentence for `sinew_last_error` of this thread.
    pub(crate) fn tell(self) -> Status {
        let mut bytes = self.sentence.into_bytes();
        // What a peer said may have any bytes.
        bytes.retain(|byte| *byte != 0);
        let sentence = CString::new(bytes).expect("its zeros are taken out");
        // A thread that is ending keeps no sentence; the status is told in any case.
        let _ = LAST.try_with(|last| last.replace(sentence));
        self.status
    }
}

impl From<ApiError> for Fault {
    fn from(error: ApiError) -> Self {
        let sentence = in_c(&error);
        let status = match error {
            ApiError::NoNode { .. } => Status::SinewErrorNoNode,
            ApiError::NotAPath { .. } | ApiError::BadName { .. } => Status::SinewErrorInvalidArgument,
            ApiError::Refused(_) => Status::SinewErrorRefused,
            ApiError::Waiting { .. } => Status::SinewErrorWaiting,
            ApiError::NoAnswer(_) => Status::SinewErrorNoAnswer,
            ApiError::Disconnected(_) => Status::SinewErrorDisconnected,
            ApiError::Closed(_) | ApiError::Frame(_) => Status::SinewErrorClosed,
            ApiError::Stalled(_) => Status::SinewErrorStalled,
            ApiError::TooLong { .. } => Status::SinewErrorTooLong,
            ApiError::Ended(_) | ApiError::TooManyGroups => Status::SinewErrorNotHandled,
            ApiError::NoReply(_) => Status::SinewErrorNoReply,
            ApiError::Malformed(_) => Status::SinewErrorMalformed,
            ApiError::NotAsked => Status::SinewErrorNotAsked,
            ApiError::OthersRequest(_) => Status::SinewErrorNoSuchMessage,
            ApiError::LoanActive => Status::SinewErrorLoanActive,
            // C sends to TIDs, and no payloads whose types Rust knows: the last two do not come here.
            ApiError::NotYours(_)
            | ApiError::ToMany(_)
            | ApiError::NotSealed(_)
            | ApiError::UnknownName { .. } => Status::SinewErrorInvalidArgument,
        };
        Self::new(status, sentence)
    }
}

/// What an error says, with the names that things have in C.
fn in_c(error: &ApiError) -> String {
    match error {
        ApiError::NotAsked => {
            "the message asks for no reply; only what was sent with sinew_ask does: look at its \
                               `wants_reply` first"
                .to_owned()
        }
        ApiError::NotYours(kind) => {
            format!("the kind {kind} belongs to Sinew's layers; take one from sinew_kind_named")
        }
        ApiError::LoanActive => {
            "a message of this endpoint is lent, before which nothing else goes out; hand it to \
                           sinew_send_message or sinew_discard_message first"
                .to_owned()
        }
        ApiError::ToMany(tid) => format!(
            "{tid} is more than one application, so that the message has an outcome for each; send it with \
             sinew_send_message_confirmed_by_each"
        ),
        ApiError::Ended(outcome) => text_of(*outcome).to_string_lossy().into_owned(),
        ApiError::Disconnected(why) => format!(
            "the connection to the node has ended: {why}; the endpoint registers again by itself, go on with \
             sinew_receive_message"
        ),
        ApiError::Waiting { .. }
        | ApiError::NoNode { .. }
        | ApiError::NotAPath { .. }
        | ApiError::BadName { .. }
        | ApiError::Refused(_)
        | ApiError::NoAnswer(_)
        | ApiError::Closed(_)
        | ApiError::Stalled(_)
        | ApiError::TooLong { .. }
        | ApiError::TooManyGroups
        | ApiError::NotSealed(_)
        | ApiError::UnknownName { .. }
        | ApiError::NoReply(_)
        | ApiError::OthersRequest(_)
        | ApiError::Malformed(_)
        | ApiError::Frame(_) => error.to_string(),
    }
}

thread_local! {
    static LAST: RefCell<CString> = RefCell::default();
}

/// The sentence about this thread's last error; empty if there was none. It stays where it is until the next one.
pub(crate) fn last_sentence() -> *const std::ffi::c_char {
    LAST.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn every_status_has_a_number_and_a_text_of_its_own() {
        let numbers: HashSet<_> = Status::ALL.iter().map(|status| *status as i32).collect();
        let texts: HashSet<_> = numbers.iter().map(|number| Status::text_of(*number)).collect();
        assert_eq!((numbers.len(), texts.len()), (Status::ALL.len(), Status::ALL.len()));
        assert!(!texts.contains(Status::text_of(1_000)));
    }

    #[test]
    fn what_an_error_says_names_nothing_of_rusts() {
        let kind = sinew::message::Kind::from_bits(1);
        let outcomes = (0..=u8::MAX).filter_map(sinew::Outcome::from_code).map(ApiError::Ended);
        let spoken = [
            ApiError::NotAsked,
            ApiError::NotYours(kind),
            ApiError::Disconnected("why".to_owned()),
            ApiError::LoanActive,
        ];
        for error in spoken.into_iter().chain(outcomes) {
            let Fault { sentence, .. } = error.into();
            for rusts in ["::", "`ask`", "Rejected(", "PeerLost"] {
                assert!(!sentence.contains(rusts), "{sentence}");
            }
        }
    }

    #[test]
    fn a_sentence_with_zeros_in_it_is_told_without_them() {
        Fault::new(Status::SinewErrorRefused, "no\0 way").tell();
        // SAFETY: the sentence is a C string that stays until this thread's next fault.
        let told = unsafe { CStr::from_ptr(last_sentence()) };
        assert_eq!(told, c"no way");
    }
}
