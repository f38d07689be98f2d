//! The end of a client's connection: its cause, the notification of others, and the final refusal to the client.

use std::{io, time::Duration};

use rustix::net::Shutdown;
use sinew_model::cause::Cause;
use sinew_protocol::{
    payload::{self, Refusal},
    ring::{ExchangeError, RingError},
};
use sinew_runtime::{
    monitor::DownClass,
    time::Time,
    wire::{FrameError, Kind, Message},
};
use sinew_session::outlet::PeerReadHalf;
use sinew_shm::PassError;

use super::{
    super::{
        link::{ClientSocket, LinkError},
        link_broker::Departure,
        registrar,
    },
    Client, Ring,
    writing::write_now,
};

/// Deadline of the final refusal if earlier messages fill the client's socket.
pub(super) const REFUSAL_TIMEOUT: Duration = Duration::from_millis(100);

/// Reason for the end of a connection.
#[derive(Debug)]
pub(super) enum ConnectionEnd {
    /// The client gave up its address.
    Unregistered,
    /// The process closed its socket, or ended. With another cause, this node could not read or write the socket.
    HungUp(Option<io::Error>),
    /// The node refused it.
    Refused(String),
    /// Its rings were not ready in time, or this node lacked descriptors or memory for them. It is not at fault, so it
    /// may register again.
    Late(String),
}

impl ConnectionEnd {
    /// Returns the cause that watchers of the application are notified of.
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

    /// Returns whether the client may still read its shared memory.
    fn peer_read_half(&self) -> PeerReadHalf {
        match self {
            Self::HungUp(Some(cause)) if !is_disconnect(cause) => PeerReadHalf::MayBeOpen,
            // A client that closed its connection reads no more from it.
            Self::Unregistered | Self::HungUp(_) => PeerReadHalf::Closed,
            Self::Refused(_) | Self::Late(_) => PeerReadHalf::MayBeOpen,
        }
    }

    /// Returns the end of a connection after a failed write.
    pub(super) fn of_write(cause: io::Error) -> Self {
        if cause.kind() == io::ErrorKind::InvalidData {
            Self::Refused(cause.to_string())
        } else {
            Self::HungUp(Some(cause))
        }
    }
}

impl From<LinkError> for ConnectionEnd {
    fn from(error: LinkError) -> Self {
        match error {
            LinkError::Ring(RingError::Frame(error)) => error.into(),
            LinkError::Ring(RingError::Corrupt(_)) | LinkError::StrayBytes => {
                Self::Refused(error.to_string())
            }
        }
    }
}

impl From<ExchangeError> for ConnectionEnd {
    fn from(error: ExchangeError) -> Self {
        let (sentence, is_of_this_side) = (error.to_string(), error.is_of_this_side());
        if matches!(error, ExchangeError::Pass(PassError::Closed)) {
            return Self::HungUp(None);
        }
        if let ExchangeError::Pass(PassError::System(cause)) = error
            && is_disconnect(&cause)
        {
            return Self::HungUp(Some(cause));
        }
        if is_of_this_side {
            return Self::Late(format!("{sentence}; register again"));
        }
        Self::Refused(sentence)
    }
}

/// Returns whether the error means that the peer is gone.
fn is_disconnect(cause: &io::Error) -> bool {
    matches!(cause.kind(), io::ErrorKind::BrokenPipe | io::ErrorKind::ConnectionReset)
}

impl From<FrameError> for ConnectionEnd {
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
    /// Sends the final refusal, if there is one.
    pub(super) async fn finish(mut self, end: ConnectionEnd) {
        self.is_notified = true;
        self.cause = end.cause();
        self.peer_read_half = if matches!(self.departure, Departure::ProcessEnded) {
            PeerReadHalf::Closed
        } else {
            end.peer_read_half()
        };
        match end {
            ConnectionEnd::Unregistered => self.log("has unregistered"),
            ConnectionEnd::HungUp(None) => self.log("has ended: its process closed the socket, or ended"),
            ConnectionEnd::HungUp(Some(cause)) => self.log(&format!("has ended: {cause}")),
            // spec: LNCL-4
            ConnectionEnd::Refused(sentence) => {
                self.count("protocol violation", &sentence);
                self.send_final_refusal(sentence).await;
            }
            // spec: LNCL-9
            ConnectionEnd::Late(sentence) => {
                self.count("no rings in time", &sentence);
                self.send_refusal_now(sentence, true);
            }
        }
    }

    fn count(&self, cause: &'static str, sentence: &str) {
        let detail = format!("{} ({}): {sentence}", self.name, self.tid);
        self.server.refusals.count(Time::now(), cause, &detail);
    }

    async fn send_final_refusal(&self, sentence: String) {
        if self.ring == Ring::Announced {
            return self.send_refusal_now(sentence, false);
        }
        self.submit(self.refusal(sentence, false));
        // Without a link nothing was written yet, so the socket takes one sentence at once.
        let link = self.link.unwrap_or_else(|| {
            let payload_max = self.server.state.ctx.config.payload_max;
            self.outlet.connect(ClientSocket::Plain(self.peer.stream.clone()), payload_max, None)
        });
        if self.outlet.waiting() > 0 {
            // Data that the socket does not take within this time has no reader.
            let _ = tokio::time::timeout(REFUSAL_TIMEOUT, self.outlet.drain(link)).await;
        }
    }

    /// Sends the reason of the end, without waiting.
    fn send_refusal_now(&self, sentence: String, again: bool) {
        let refusal = self.refusal(sentence, again);
        match self.ring {
            Ring::None | Ring::Supported => self.submit(refusal),
            // The ring may be full or missing, and the socket carries no data besides this refusal. A peer that is gone
            // needs none.
            Ring::Announced => drop(write_now(&self.peer.stream, &refusal)),
        }
    }

    fn refusal(&self, sentence: String, again: bool) -> Message {
        let lncl = payload::lncl_of(self.tid.node);
        payload::frame(Kind::LNCL_REFUSAL, lncl, self.tid, &Refusal { sentence, again })
    }

    fn log(&self, what: &str) {
        if let Some(suppressed) = self.server.state.ctx.log_quotas.clients.take(&self.name, Time::now()) {
            let (tid, name, pid) = (self.tid, &self.name, self.peer.pid);
            let suppressed = (suppressed > 0).then_some(suppressed);
            if self.is_named {
                sinew_runtime::log::info!(%tid, name, pid, suppressed, "an application of another process {what}");
            } else {
                sinew_runtime::log::debug!(%tid, pid, suppressed, "an application of another process {what}");
            }
        }
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        let departure = std::mem::replace(&mut self.departure, Departure::LinksRemain);
        self.server.link_broker.remove(self.tid, departure);
        self.server.state.observed_links.remove(self.tid);
        match &self.command {
            // Its supervisor reports the end of the process.
            Some(port) => {
                registrar::release_command(&self.server.state, port, self.tid.app, self.peer.id);
            }
            None => registrar::remove_owner(&self.server.state, self.peer.owner(), &self.cause),
        }
        self.server.remove_client(self.peer.id);
        if !self.is_notified {
            self.send_refusal_now(
                "the node's LNCL has ended; connect again when it is back".to_owned(),
                true,
            );
        }
        // Senders may hold the outlet, and with it the socket, a little longer; the shutdown notifies the peer now. An
        // error means that it is closed already.
        let _ = rustix::net::shutdown(&self.peer.stream, Shutdown::Both);
        // spec: LNCL-7. The end of the outlet wakes a peer that sleeps at a ring; it then reads the remaining data.
        self.outlet.end(self.peer_read_half);
        self.server.state.book.remove_client(self.peer.id);
    }
}

#[cfg(test)]
mod tests {
    use rustix::io::Errno;
    use sinew_shm::OfferError;

    use super::*;

    #[test]
    fn client_that_ends_before_its_rings_is_not_refused() {
        let ended = |errno: Errno| ConnectionEnd::from(ExchangeError::Pass(PassError::System(errno.into())));
        for errno in [Errno::PIPE, Errno::CONNRESET] {
            assert_eq!(ended(errno).cause().class, DownClass::ProcessEnded, "{errno}");
        }
        // A resource shortage of this node is not the client's fault; an invalid offer is.
        for errno in [Errno::MFILE, Errno::NFILE, Errno::NOMEM] {
            assert!(matches!(ended(errno), ConnectionEnd::Late(_)), "{errno}");
        }
        assert!(matches!(
            ConnectionEnd::from(ExchangeError::Refused(OfferError::Kind)),
            ConnectionEnd::Refused(_)
        ));
    }

    // spec: LNCL-7
    #[test]
    fn client_may_still_read_after_a_shortage() {
        for (errno, half) in [
            (Errno::PIPE, PeerReadHalf::Closed),
            (Errno::CONNRESET, PeerReadHalf::Closed),
            (Errno::NOMEM, PeerReadHalf::MayBeOpen),
            (Errno::NOBUFS, PeerReadHalf::MayBeOpen),
        ] {
            let read = ConnectionEnd::from(FrameError::Io(errno.into()));
            let written = ConnectionEnd::of_write(errno.into());
            assert_eq!([read.peer_read_half(), written.peer_read_half()], [half; 2], "{errno}");
        }
    }
}
