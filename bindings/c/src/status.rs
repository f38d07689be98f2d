//! The result of a call: a number, a text for each number, and a sentence about this case.

use std::{cell::RefCell, ffi::CStr, ffi::CString};

use sinew_client::ApiError;

use crate::outcome::text_of;

/// The result of a call. Negative: an error, and `sinew_last_error` has a sentence about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
#[allow(
    clippy::enum_variant_names,
    dead_code,
    reason = "these are the names in C, which has no other name spaces, and C may hand them back"
)]
pub enum Status {
    /// Success.
    SinewOk = 0,
    /// No error, but no result: no message arrived in time, or no application has the name.
    SinewNothing = 1,
    /// An argument is NULL, no UTF-8, too long, or none of its legal values. Nothing was sent or registered.
    SinewErrorInvalidArgument = -1,
    /// No node listens at the path, or this user may not connect. Nothing was done.
    SinewErrorNoNode = -2,
    /// The node rejected the registration, or a wait at a barrier; the sentence says why. Nothing is
    /// registered.
    SinewErrorRefused = -3,
    /// A requirement was not ready at the deadline. Nothing is registered.
    SinewErrorWaiting = -4,
    /// The node did not answer in time. Whether it executed the request is not known.
    SinewErrorNoAnswer = -5,
    /// The connection to the node has ended, and the registration with it: unregister, then register again.
    SinewErrorClosed = -6,
    /// There was no room in time: the node or, on a direct link, the receiver is stopped or too slow. Nothing
    /// of the message is received; it may be created and sent again.
    SinewErrorStalled = -7,
    /// The payload is longer than `sinew_payload_max`. Nothing was sent.
    SinewErrorTooLong = -8,
    /// A request was not handled, or a group not joined. The outcome and the sentence say why.
    SinewErrorNotHandled = -9,
    /// No reply came in time. The request may have been handled.
    SinewErrorNoReply = -10,
    /// The message requests no reply. Nothing was sent.
    SinewErrorNotAsked = -11,
    /// The received bytes are not a value of their kind.
    SinewErrorMalformed = -12,
    /// This is no endpoint: it is NULL, or was unregistered, or never registered. Nothing was done.
    SinewErrorNoSuchEndpoint = -13,
    /// Another thread is in a call on this endpoint. Nothing was done.
    SinewErrorBusy = -14,
    /// This is no message of this endpoint: it was sent, discarded or settled already. Nothing was done.
    SinewErrorNoSuchMessage = -15,
    /// Too many endpoints in this process, or too many unsettled messages. Nothing was sent or registered.
    SinewErrorTooMany = -16,
    /// The endpoint belongs to the process that this one was forked from. Nothing was done.
    SinewErrorForked = -17,
    /// A fault of this library. The endpoint can only be unregistered; all others keep working.
    SinewErrorPanic = -18,
    /// A message is on loan, neither sent nor discarded: the endpoint sends nothing else before. Nothing was
    /// sent.
    SinewErrorLoanActive = -19,
    /// The connection to the node has ended, through no fault of this endpoint, which registers again by
    /// itself while it is used: continue. Each send without a time limit tries, and `sinew_receive_message`,
    /// which returns this once, waits for it. The message was not sent.
    SinewErrorDisconnected = -20,
    /// Not all parties arrived at the barrier in time. The sentence says which are missing; the others keep
    /// waiting.
    SinewErrorNotMet = -21,
    /// A party of the barrier was lost, and the flags say not to wait for it. The sentence says which.
    SinewErrorPartyLost = -22,
    /// This is no guard: it is NULL, or was released, or never created. Nothing was done.
    SinewErrorNoSuchGuard = -23,
    /// Too few good messages in a row have arrived, or the last one too long ago: the output cannot be armed
    /// yet. It stays safe.
    SinewErrorNotGood = -24,
    /// `sinew_make_safe` reports failure: whether the output is safe is not known. It is called again each
    /// millisecond, until it succeeds.
    SinewErrorSafeFails = -25,
    /// The threads that make outputs safe in time cannot be started, or are not more urgent than the calling
    /// thread. No guard was created.
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

    /// Returns the text for a number; a number that is no status has a text that says so.
    pub(crate) fn text_of(code: i32) -> &'static CStr {
        let status = Self::ALL.iter().find(|status| **status as i32 == code);
        status.map_or(c"no status of this library", |status| status.text())
    }

    const fn text(self) -> &'static CStr {
        match self {
            Self::SinewOk => c"done",
            Self::SinewNothing => c"no message arrived, or no application has the name",
            Self::SinewErrorInvalidArgument => {
                c"an argument is NULL, no UTF-8, too long, or none of its legal values"
            }
            Self::SinewErrorNoNode => {
                c"no node can be reached at this path; does it run, with this path as its `lncl.socket`?"
            }
            Self::SinewErrorRefused => c"the node refused the registration, or a wait at a barrier",
            Self::SinewErrorWaiting => c"a requirement was not ready at the deadline",
            Self::SinewErrorNoAnswer => c"the node did not answer in time; does it hang?",
            Self::SinewErrorClosed => c"the connection to the node has ended; register again",
            Self::SinewErrorStalled => {
                c"no room in time: the node, or the receiver on a direct link, is stopped or too slow; it was not sent"
            },
            Self::SinewErrorTooLong => c"the payload is above the node's limit; raise `payload_max`",
            Self::SinewErrorNotHandled => c"it was not handled",
            Self::SinewErrorNoReply => c"no reply came in time",
            Self::SinewErrorNotAsked => c"the message requests no reply",
            Self::SinewErrorMalformed => {
                c"the received bytes are not a value of their kind; do both sides use the same type?"
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
            Self::SinewErrorTooMany => c"too many endpoints in this process, or too many unsettled messages",
            Self::SinewErrorForked => {
                c"this endpoint belongs to the process that this one was forked from; register another one"
            }
            Self::SinewErrorLoanActive => {
                c"a message of this endpoint is on loan; pass it to sinew_send_message or sinew_discard_message first"
            }
            Self::SinewErrorDisconnected => {
                c"the connection to the node has ended; the endpoint registers again by itself while it is used"
            }
            Self::SinewErrorNotMet => c"not all parties arrived at the barrier in time",
            Self::SinewErrorPartyLost => c"a party of the barrier was lost",
            Self::SinewErrorNoSuchGuard => c"this is no guard; is it NULL, was it released, or never created?",
            Self::SinewErrorNotGood => {
                c"too few good messages in a row have arrived, or the last one too long ago, to arm the output"
            }
            Self::SinewErrorSafeFails => {
                c"sinew_make_safe reports failure; it is called again each millisecond"
            }
            Self::SinewErrorNoWatchdog => {
                c"the threads that make outputs safe cannot be started, or are not more urgent than this thread"
            }
            Self::SinewErrorPanic => {
                c"a fault of this library; the endpoint can only be unregistered; please report it"
            }
        }
    }
}

/// The reason why a call failed.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct CallError {
    pub(crate) status: Status,
    sentence: String,
}

impl CallError {
    pub(crate) fn new(status: Status, sentence: impl Into<String>) -> Self {
        Self { status, sentence: sentence.into() }
    }

    /// An error with the text of its status only.
    pub(crate) fn plain(status: Status) -> Self {
        Self::new(status, status.text().to_string_lossy())
    }

    pub(crate) fn argument(sentence: impl Into<String>) -> Self {
        Self::new(Status::SinewErrorInvalidArgument, sentence)
    }

    /// Keeps the sentence for `sinew_last_error` of this thread.
    pub(crate) fn record(self) -> Status {
        let mut bytes = self.sentence.into_bytes();
        // A text from a peer may contain any bytes.
        bytes.retain(|byte| *byte != 0);
        let sentence = CString::new(bytes).expect("its zeros are taken out");
        // A thread that is ending keeps no sentence; the status is returned in any case.
        let _ = LAST.try_with(|last| last.replace(sentence));
        self.status
    }
}

impl From<ApiError> for CallError {
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
            // C sends to TIDs, and no payloads of Rust types: the last two do not occur here.
            ApiError::NotYours(_)
            | ApiError::ToMany(_)
            | ApiError::NotSealed(_)
            | ApiError::UnknownName { .. } => Status::SinewErrorInvalidArgument,
        };
        Self::new(status, sentence)
    }
}

/// Returns an error's text, with the names that things have in C.
fn in_c(error: &ApiError) -> String {
    match error {
        ApiError::NotAsked => {
            "the message requests no reply; only a message sent with sinew_ask does: check its \
                               `wants_reply` first"
                .to_owned()
        }
        ApiError::NotYours(kind) => {
            format!("the kind {kind} belongs to Sinew's layers; take one from sinew_kind_named")
        }
        ApiError::LoanActive => {
            "a message of this endpoint is on loan, and nothing else is sent before it; pass it to \
                           sinew_send_message or sinew_discard_message first"
                .to_owned()
        }
        ApiError::ToMany(tid) => format!(
            "{tid} is more than one application, so that the message has an outcome for each; send it with \
             sinew_send_message_confirmed_by_each"
        ),
        ApiError::Ended(outcome) => text_of(*outcome).to_string_lossy().into_owned(),
        ApiError::Disconnected(why) => format!(
            "the connection to the node has ended: {why}; the endpoint registers again by itself; continue with \
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

/// The sentence about this thread's last error; empty if there was none. It stays in place until the next
/// error.
pub(crate) fn last_sentence() -> *const std::ffi::c_char {
    LAST.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn every_status_has_a_unique_number_and_text() {
        let numbers: HashSet<_> = Status::ALL.iter().map(|status| *status as i32).collect();
        let texts: HashSet<_> = numbers.iter().map(|number| Status::text_of(*number)).collect();
        assert_eq!((numbers.len(), texts.len()), (Status::ALL.len(), Status::ALL.len()));
        assert!(!texts.contains(Status::text_of(1_000)));
    }

    #[test]
    fn error_texts_use_no_rust_names() {
        let kind = sinew_runtime::wire::Kind::from_bits(1);
        let outcomes =
            (0..=u8::MAX).filter_map(sinew_runtime::outcome::Outcome::from_code).map(ApiError::Ended);
        let errors = [
            ApiError::NotAsked,
            ApiError::NotYours(kind),
            ApiError::Disconnected("why".to_owned()),
            ApiError::LoanActive,
        ];
        for error in errors.into_iter().chain(outcomes) {
            let CallError { sentence, .. } = error.into();
            for rusts in ["::", "`ask`", "Rejected(", "PeerLost"] {
                assert!(!sentence.contains(rusts), "{sentence}");
            }
        }
    }

    #[test]
    fn zero_bytes_are_removed_from_a_sentence() {
        CallError::new(Status::SinewErrorRefused, "no\0 way").record();
        // SAFETY: the sentence is a C string that stays until this thread's next error.
        let told = unsafe { CStr::from_ptr(last_sentence()) };
        assert_eq!(told, c"no way");
    }
}
