//! The end of a client's connection: why, what others are told of it, and the last words to the client itself.

use std::{io, time::Duration};

use rustix::net::Shutdown;
use sinew_runtime::{
    monitor::DownClass,
    time::Time,
    wire::{FrameError, Kind, Message},
};
use sinew_shm::PassError;

use super::{
    super::{
        introductions::Leaves,
        link::{ClientSocket, LinkError},
        payload::{self, Refusal},
        registrar,
    },
    Client, Ring, write_now,
};
use crate::{
    monitors::Cause,
    outlet::Left,
    ring::{ExchangeError, RingError},
};

/// Time that a client has to take its refusal when earlier messages fill its socket.
pub(super) const LAST_WORDS: Duration = Duration::from_millis(100);

/// Why a connection ended.
#[derive(Debug)]
pub(super) enum End {
    /// It gave its address back.
    Unregistered,
    /// The process closed its socket, or ended; or, with a cause that says something else, this node could not read or write there.
    HungUp(Option<io::Error>),
    /// It was refused.
    Refused(String),
    /// Its rings were not there in time, or this node had no descriptor or memory left for them, which is not its fault: it may register
    /// again.
    Late(String),
}

impl End {
    /// What those are told who watch the application.
    pub(super) fn cause(&self) -> Cause {
        match self {
            Self::Unregistered => Cause::new(DownClass::Normal, "it unregistered"),
            Self::HungUp(_) => {
                Cause::new(DownClass::ProcessEnded, "its process ended, or closed its connection")
            }
            Self::Refused(sentence) | Self::Late(sentence) => {
                Cause::new(DownClass::Killed, format!("its connection was ended: {sentence}"))
            }
        }
    }

    /// Whether the client takes what lies in its memory yet.
    fn left(&self) -> Left {
        match self {
            Self::HungUp(Some(cause)) if !has_gone(cause) => Left::Somebody,
            // Who closes its connection takes nothing more from it.
            Self::Unregistered | Self::HungUp(_) => Left::Nobody,
            Self::Refused(_) | Self::Late(_) => Left::Somebody,
        }
    }

    /// The end of a connection that could not be written to.
    pub(super) fn of_write(cause: io::Error) -> Self {
        if cause.kind() == io::ErrorKind::InvalidData {
            Self::Refused(cause.to_string())
        } else {
            Self::HungUp(Some(cause))
        }
    }
}

impl From<LinkError> for End {
    fn from(error: LinkError) -> Self {
        match error {
            LinkError::Ring(RingError::Frame(error)) => error.into(),
            LinkError::Ring(RingError::Corrupt(_)) | LinkError::StrayBytes => {
                Self::Refused(error.to_string())
            }
        }
    }
}

impl From<ExchangeError> for End {
    fn from(error: ExchangeError) -> Self {
        let (sentence, is_of_this_side) = (error.to_string(), error.is_of_this_side());
        if matches!(error, ExchangeError::Pass(PassError::Closed)) {
            return Self::HungUp(None);
        }
        if let ExchangeError::Pass(PassError::System(cause)) = error
            && has_gone(&cause)
        {
            return Self::HungUp(Some(cause));
        }
        if is_of_this_side {
            return Self::Late(format!("{sentence}; register again"));
        }
        Self::Refused(sentence)
    }
}

/// Whether it says that nobody is at the other end any more.
fn has_gone(cause: &io::Error) -> bool {
    matches!(cause.kind(), io::ErrorKind::BrokenPipe | io::ErrorKind::ConnectionReset)
}

impl From<FrameError> for End {
    fn from(error: FrameError) -> Self {
        match error {
            FrameError::Io(cause) if cause.kind() == io::ErrorKind::InvalidData => {
                Self::Refused(cause.to_string())
            }
            FrameError::Io(cause) => Self::HungUp(Some(cause)),
            FrameError::Header(_) | FrameError::TooLong { .. } => Self::Refused(error.to_string()),
        }
    }
}

impl Client {
    /// Says the last words, if there are any.
    pub(super) async fn finish(mut self, end: End) {
        self.has_been_told = true;
        self.cause = end.cause();
        self.left = if matches!(self.leaves, Leaves::Dead) { Left::Nobody } else { end.left() };
        match end {
            End::Unregistered => self.log("has unregistered"),
            End::HungUp(None) => self.log("has gone: its process closed the socket, or ended"),
            End::HungUp(Some(cause)) => self.log(&format!("has gone: {cause}")),
            // spec: LNCL-4
            End::Refused(sentence) => {
                self.count("protocol violation", &sentence);
                self.say_farewell(sentence).await;
            }
            // spec: LNCL-9
            End::Late(sentence) => {
                self.count("no rings in time", &sentence);
                self.say_last(sentence, true);
            }
        }
    }

    fn count(&self, cause: &'static str, sentence: &str) {
        let detail = format!("{} ({}): {sentence}", self.name, self.tid);
        self.server.refusals.count(Time::now(), cause, &detail);
    }

    async fn say_farewell(&self, sentence: String) {
        if self.ring == Ring::Told {
            return self.say_last(sentence, false);
        }
        self.say(self.refusal(sentence, false));
        // Without a link nothing was written yet, and the socket takes a sentence at once.
        let link = self.link.unwrap_or_else(|| {
            let payload_max = self.server.stores.config.payload_max;
            self.outlet.connect(ClientSocket::Plain(self.peer.stream.clone()), payload_max, None)
        });
        if self.outlet.waiting() > 0 {
            // What the socket does not take in this time is not read by anybody.
            let _ = tokio::time::timeout(LAST_WORDS, self.outlet.drain(link)).await;
        }
    }

    /// Says why it ends, without waiting.
    fn say_last(&self, sentence: String, again: bool) {
        let refusal = self.refusal(sentence, again);
        match self.ring {
            Ring::None | Ring::Asked => self.say(refusal),
            // The ring may be full or not there yet, and nothing but these words ever goes into the socket. Whoever is
            // gone need not hear them.
            Ring::Told => drop(write_now(&self.peer.stream, &refusal)),
        }
    }

    fn refusal(&self, sentence: String, again: bool) -> Message {
        let lncl = payload::lncl_of(self.tid.node);
        payload::frame(Kind::LNCL_REFUSAL, lncl, self.tid, &Refusal { sentence, again })
    }

    fn log(&self, what: &str) {
        if let Some(suppressed) = self.server.stores.log_quotas.clients.take(&self.name, Time::now()) {
            let (tid, name, pid) = (self.tid, &self.name, self.peer.pid);
            let suppressed = (suppressed > 0).then_some(suppressed);
            if self.is_named {
                crate::log::info!(%tid, name, pid, suppressed, "an application of another process {what}");
            } else {
                crate::log::debug!(%tid, pid, suppressed, "an application of another process {what}");
            }
        }
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        let leaves = std::mem::replace(&mut self.leaves, Leaves::WithItsLinks);
        self.server.introductions.remove(self.tid, leaves);
        registrar::owner_gone(&self.server.stores, self.peer.owner(), &self.cause);
        self.server.remove_client(self.peer.id);
        if !self.has_been_told {
            self.say_last("the node's LNCL has ended; connect again when it is back".to_owned(), true);
        }
        // Senders may hold the outlet, and with it the socket, a little longer; the peer is told now. An error means
        // that it is closed already.
        let _ = rustix::net::shutdown(&self.peer.stream, Shutdown::Both);
        // spec: LNCL-7. A peer that sleeps at a ring is woken by its end, and takes what lies in it.
        self.outlet.end(self.left);
        self.server.stores.book.remove_client(self.peer.id);
    }
}

#[cfg(test)]
mod tests {
    use rustix::io::Errno;
    use sinew_shm::RefusedOffer;

    use super::*;

    #[test]
    fn who_has_gone_before_its_rings_were_made_is_neither_refused_nor_told_to_come_again() {
        let ended = |errno: Errno| End::from(ExchangeError::Pass(PassError::System(errno.into())));
        for errno in [Errno::PIPE, Errno::CONNRESET] {
            assert_eq!(ended(errno).cause().class, DownClass::ProcessEnded, "{errno}");
        }
        // What this node is short of is no fault of the client's; what it offers is.
        for errno in [Errno::MFILE, Errno::NFILE, Errno::NOMEM] {
            assert!(matches!(ended(errno), End::Late(_)), "{errno}");
        }
        assert!(matches!(End::from(ExchangeError::Refused(RefusedOffer::Kind)), End::Refused(_)));
    }

    // spec: LNCL-7
    #[test]
    fn who_lives_when_this_node_is_short_of_something_takes_what_lies_in_its_memory_yet() {
        for (errno, left) in [
            (Errno::PIPE, Left::Nobody),
            (Errno::CONNRESET, Left::Nobody),
            (Errno::NOMEM, Left::Somebody),
            (Errno::NOBUFS, Left::Somebody),
        ] {
            let read = End::from(FrameError::Io(errno.into()));
            let written = End::of_write(errno.into());
            assert_eq!([read.left(), written.left()], [left; 2], "{errno}");
        }
    }
}
