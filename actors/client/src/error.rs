//! The errors between an application and its node.

use std::{fmt, io, path::PathBuf, time::Duration};

use sinew_runtime::{
    name::NameError,
    outcome::Outcome,
    protection::SealError,
    tid::Tid,
    wire::{DecodeError, FrameError, Kind},
};

use super::link::UntrustedServerError;

/// Why an operation of NodeAPI failed.
///
/// # Examples
///
/// ```
/// use std::time::Duration;
///
/// use sinew::{Endpoint, client::{ApiError, Received}};
///
/// /// Continues when the node was restarted: the endpoint registers again by itself.
/// fn receive(endpoint: &mut Endpoint) -> Result<Option<Received>, ApiError> {
///     match endpoint.receive(Duration::from_millis(10)) {
///         Err(ApiError::Disconnected(why)) => {
///             eprintln!("without a node: {why}");
///             Ok(None)
///         }
///         other => other,
///     }
/// }
/// ```
#[derive(thiserror::Error)]
pub enum ApiError {
    /// No process listens at the path, this process may not connect to it, or the listening process is not
    /// trusted ([`NodeApi::connect_trusted`](super::NodeApi::connect_trusted)). The environment is at fault;
    /// nothing changed.
    #[error("no node can be reached at {path:?}: {cause}; {}", connect_remedy(cause))]
    NoNode {
        /// The path.
        path: PathBuf,
        /// The error of the system.
        cause: io::Error,
    },
    /// The path is invalid for a socket. The caller is at fault; nothing changed.
    #[error(
        "{path:?} is not the path of a node's socket: {why}; give the one that the node's configuration has as its `lncl.socket`"
    )]
    NotAPath {
        /// The path.
        path: PathBuf,
        /// The fault of the path.
        why: &'static str,
    },
    /// The name is invalid for a group. The caller is at fault; nothing changed.
    #[error("the name {name:?} cannot be used: {why}")]
    BadName {
        /// The name, or its beginning.
        name: String,
        /// The rule of [names](sinew_runtime::name) that it breaks.
        why: NameError,
    },
    /// The node refused, with this reason. The connection is closed and nothing is registered.
    #[error("the node refused: {0}")]
    Refused(String),
    /// The registration's deadline passed at the start-up barrier. Nothing is registered.
    #[error(
        "after {waited:?} still waiting for these to be ready: {}; start what is missing, or give the registration a longer deadline",
        missing.join(", ")
    )]
    Waiting {
        /// The missing requirements, each with the node's information about it. All requirements, if the
        /// deadline passed before the node had checked them.
        missing: Vec<String>,
        /// How long it waited.
        waited: Duration,
    },
    /// The node did not answer in time. Whether it executed the request is unknown.
    #[error("the node did not answer within {0:?}; is it stopped, or its host overloaded? Its log says more")]
    NoAnswer(Duration),
    /// The connection has ended, and the registration with it; register again.
    #[error(
        "the connection to the node has ended: {0}; this endpoint does not come back, register a new one"
    )]
    Closed(String),
    /// The connection has ended through no fault of this endpoint, which registers again automatically while
    /// it is used: each send tries, and [`receive`](super::Endpoint::receive) waits for it. A message of this
    /// call was not sent.
    #[error(
        "the connection to the node has ended: {0}; the endpoint registers again by itself; continue with `receive`"
    )]
    Disconnected(String),
    /// There was no room for this long: the stall timeout of the endpoint, or the limit of the call. Or
    /// another send had reached its stall timeout before, and the peer has read nothing since. The receiver
    /// gets nothing of this message; it may be sent again.
    #[error(
        "no room for the message for {0:?}, it was not sent: the node, or the receiver on a direct link, is stopped or slower than \
         messages come; send less often, or as a Stream, of which only the newest value waits"
    )]
    Stalled(Duration),
    /// A lent message was neither sent nor dropped, so nothing else can be sent from its endpoint: see
    /// [`LoanedMessage`](super::LoanedMessage). The caller is at fault; nothing was sent.
    #[error("this endpoint has lent memory for a message; send that message or drop it first")]
    LoanActive,
    /// The payload is above the node's limit. The caller is at fault; nothing was sent.
    #[error(
        "a payload of {length} bytes is above the node's limit of {limit}; raise `node.payload_max` on all nodes, or send it in parts"
    )]
    TooLong {
        /// Length of the payload.
        length: usize,
        /// The node's limit.
        limit: usize,
    },
    /// The kind is one of the layers' own. The caller is at fault; nothing was sent.
    #[error(
        "the kind {0} belongs to Sinew's layers, which would end the connection; take one from `Kind::named`"
    )]
    NotYours(Kind),
    /// A group or a broadcast has no outcome of its own: each member has one. The caller is at fault; nothing
    /// was sent.
    #[error(
        "{0} is more than one application, so that the message has an outcome for each; send it with `confirmed_by_each`"
    )]
    ToMany(Tid),
    /// No application has the name now. Nothing was sent.
    #[error(
        "no application is called '{name}' now; {}require it at registration, so that this one starts when it is there, or see `sinew apps` \
         for the names that there are",
        nearest_of(nearest)
    )]
    UnknownName {
        /// The name.
        name: String,
        /// Similar names of existing applications, at most three, the most similar first. An endpoint gets
        /// them at most once a second, and an endpoint of another user than the node's never.
        nearest: Vec<String>,
    },
    /// A request was not handled. The outcome states the reason.
    #[error("{}", not_handled(*.0))]
    Ended(Outcome),
    /// The endpoint is a member of the maximum number of groups, or its user or node has the maximum of
    /// memberships. The caller or other applications are at fault; nothing was joined.
    #[error(
        "this endpoint is a member of 256 groups, which is the most, or its node has no room for a further membership of its user, or of anybody; \
         leave one first"
    )]
    TooManyGroups,
    /// A protected payload cannot be sealed. The caller is at fault; nothing was sent.
    #[error("the message was not sent: {0}")]
    NotSealed(#[from] SealError),
    /// No reply arrived in time. The request may have been handled.
    #[error(
        "no reply came within {0:?}, the request may have been handled; is its receiver slow, or does it not reply to this kind?"
    )]
    NoReply(Duration),
    /// The message does not ask for a reply. The caller is at fault; nothing was sent.
    #[error(
        "the message requests no reply; only a message sent with `ask` does: check `Received::wants_reply` first"
    )]
    NotAsked,
    /// The request was sent to another endpoint, or to a former address of this one. The caller is at fault;
    /// nothing was sent.
    #[error(
        "the request came to {0}, which is not this endpoint's address; who asked takes a reply from there only: reply with the endpoint \
         that received it"
    )]
    OthersRequest(Tid),
    /// The payload of a message or of a reply does not match its kind. The peer is at fault.
    #[error("the payload is not what its kind says: {0}; do both programs use the same type?")]
    Malformed(#[from] DecodeError),
    /// The node sent an invalid frame. The connection is closed.
    #[error(
        "the node sent what cannot be read: {0}; are the node and this program of the same version of Sinew?"
    )]
    Frame(#[from] FrameError),
}

/// The same text as `Display`: a program that returns this error from `main` displays only this.
impl fmt::Debug for ApiError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Returns the outcome of a request, and the remedy.
fn not_handled(outcome: Outcome) -> String {
    let why = match outcome {
        Outcome::Rejected(why) => return format!("not handled, {outcome:?}: {why}"),
        Outcome::Expired => {
            "its time was over before its receiver came to it; give it more, or the receiver less to do"
        }
        Outcome::Failed => "its receiver failed or ended with it in hand; what it did of it is not known",
        Outcome::PeerLost => "the receiver's node was lost before it was sent; ask again when it is back",
        Outcome::Unknown => "the connection was lost on the way, nobody can say whether it was handled",
        Outcome::Delivered => "it was handled, and no reply follows",
    };
    format!("no reply, {outcome:?}: {why}")
}

/// Returns the remedy for a node that cannot be reached. spec: LNCL-2
fn connect_remedy(cause: &io::Error) -> &'static str {
    if cause.get_ref().is_some_and(|cause| cause.is::<UntrustedServerError>()) {
        "if that user's node is meant, name its socket: `NodeApi::connect`"
    } else if cause.kind() == io::ErrorKind::PermissionDenied {
        "this process's user may not open that socket: a node serves the user that it runs as, and root; run the application \
         as that user, and see that it may enter the socket's directories"
    } else {
        "does it run, with this path as its `lncl.socket`?"
    }
}

fn nearest_of(nearest: &[String]) -> String {
    if nearest.is_empty() { String::new() } else { format!("nearest: {}; ", nearest.join(", ")) }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::outcome::Rejection;

    use super::*;

    /// One error of each variant. A new variant must be added here.
    fn all() -> Vec<ApiError> {
        let second = Duration::from_secs(1);
        let strangers = UntrustedServerError { theirs: 1001, own: 1000 };
        let mut all = vec![
            ApiError::NoNode { path: "/tmp/sinew-0.sock".into(), cause: io::Error::other(strangers) },
            ApiError::NoNode { path: "/run/knee.sock".into(), cause: io::ErrorKind::NotFound.into() },
            ApiError::NoNode { path: "/run/knee.sock".into(), cause: io::ErrorKind::PermissionDenied.into() },
            ApiError::BadName { name: "a|b".to_owned(), why: NameError::Reserved('|') },
            ApiError::NotAPath { path: PathBuf::new(), why: "it is empty" },
            ApiError::Waiting { missing: vec!["hip".to_owned()], waited: second },
            ApiError::NoAnswer(second),
            ApiError::Closed("why".to_owned()),
            ApiError::Disconnected("why".to_owned()),
            ApiError::Stalled(second),
            ApiError::LoanActive,
            ApiError::TooLong { length: 2, limit: 1 },
            ApiError::NotYours(Kind::OUTCOME),
            ApiError::ToMany(Tid::BROADCAST),
            ApiError::UnknownName { name: "knee".to_owned(), nearest: Vec::new() },
            ApiError::UnknownName { name: "knee".to_owned(), nearest: vec!["knee.drive".to_owned()] },
            ApiError::NoReply(second),
            ApiError::NotAsked,
            ApiError::OthersRequest(Tid::NONE),
            ApiError::TooManyGroups,
            ApiError::NotSealed(SealError::ToMany),
            ApiError::NotSealed(SealError::TooManyFlows),
        ];
        let outcomes =
            (0..=u8::MAX).filter_map(Outcome::from_code).filter(|outcome| *outcome != Outcome::Delivered);
        all.extend(outcomes.map(ApiError::Ended));
        all
    }

    #[test]
    fn every_error_states_cause_and_remedy() {
        for error in all() {
            let text = error.to_string();
            let (cause, remedy) = text.split_once([';', ':']).unwrap_or_else(|| panic!("no remedy: {text}"));
            assert!(cause.len() > 10 && remedy.len() > 10, "{text}");
            // `Debug` brackets and type names mean nothing to a control engineer.
            assert!(!text.contains("ApiError") && !text.contains('{'), "{text}");
        }
        let forbidden =
            ApiError::NoNode { path: PathBuf::new(), cause: io::ErrorKind::PermissionDenied.into() };
        assert!(forbidden.to_string().contains("the user that it runs as, and root"), "{forbidden}");
        let no_room = ApiError::Ended(Outcome::Rejected(Rejection::QueueFull)).to_string();
        assert!(no_room.contains("more slowly than they come"), "{no_room}");
    }
}
