//! Authentication of the peer before any frame is trusted: the TLS handshake on a connection between nodes.
//!
//! A handshake uses a fraction of a millisecond of a CPU, and any host that can reach the port can request
//! one. A separate thread of lower priority than those that carry messages therefore does it, and yields its
//! CPU after each [`RUN`]. The lower priority is not enough: the scheduler lets a computing thread finish its
//! slice of milliseconds, even if others were woken meanwhile.

use std::{fmt, future::poll_fn, io, pin::pin, time::Duration};

use rustls::{Connection, pki_types::UnixTime};
use sinew_security::{Peer, PeerError, Tls, words};
use tokio::net::TcpStream;
use tokio_rustls::{TlsAcceptor, TlsConnector};
use tokio_util::task::AbortOnDropHandle;

use super::{bulk::BulkThread, transport::Transport, yield_policy::YieldPolicy};

/// First byte of a connection with TLS: the type of its first record, which is never a frame's first byte.
const HANDSHAKE_RECORD: u8 = 0x16;
/// Time for which the thread computes between two yields: two or three steps of handshakes, and less than the
/// wait of others for a slice.
const RUN: Duration = Duration::from_millis(1);

/// The refusal of a node without keys to a node with keys.
pub(super) const TLS_REFUSAL: &str = "you speak TLS, and this node has no keys: it is open to everybody on its network; give it those of your project \
     (`security.keys`, `sinew keys issue`), or take [security] from your configuration";
/// The refusal of a node with keys to a node without.
const PLAIN_REFUSAL: &str = "this node takes only who proves with keys of its project who it is, and you do not speak TLS: give your node such keys \
     (`security.keys`, `sinew keys issue`)";

/// Whether the first bytes of an unauthenticated peer are those of TLS.
pub(super) fn is_tls(bytes: &[u8]) -> bool {
    bytes.first() == Some(&HANDSHAKE_RECORD)
}

/// The role of this node on a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum TlsRole {
    Client,
    Server,
}

/// The reason why the peer is not authenticated.
#[derive(Debug)]
pub(super) enum AuthError {
    /// The connection ended before the authentication.
    Disconnected(io::Error),
    /// The authentication was refused, for this reason.
    Rejected(String),
    /// The peer does not use TLS, and can read an unencrypted refusal.
    NotTls,
}

impl fmt::Display for AuthError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Disconnected(error) => error.fmt(f),
            Self::Rejected(why) => f.write_str(why),
            Self::NotTls => f.write_str(PLAIN_REFUSAL),
        }
    }
}

impl From<io::Error> for AuthError {
    fn from(error: io::Error) -> Self {
        match error.get_ref().and_then(|inner| inner.downcast_ref::<rustls::Error>()) {
            Some(fault) => Self::Rejected(words(fault)),
            None => Self::Disconnected(error),
        }
    }
}

impl From<PeerError> for AuthError {
    fn from(fault: PeerError) -> Self {
        Self::Rejected(fault.to_string())
    }
}

impl From<AuthError> for io::Error {
    fn from(error: AuthError) -> Self {
        match error {
            AuthError::Disconnected(error) => error,
            why @ (AuthError::Rejected(_) | AuthError::NotTls) => {
                Self::new(io::ErrorKind::InvalidData, why.to_string())
            }
        }
    }
}

/// Both roles of a node with keys, and the thread of handshakes, which ends when this is dropped.
pub(super) struct Authenticator {
    tls: Tls,
    thread: BulkThread,
}

impl Authenticator {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system provides no thread, or no descriptors for its reactor.
    pub(super) fn begin(tls: Tls) -> io::Result<Self> {
        Ok(Self { tls, thread: BulkThread::begin("handshakes", YieldPolicy::with_min_run(RUN))? })
    }

    /// Authenticates both sides. The duration depends on the peer: the caller limits it.
    pub(super) async fn authenticate(
        &self,
        transport: Transport,
        role: TlsRole,
    ) -> Result<(Transport, Box<Peer>), AuthError> {
        if role == TlsRole::Server {
            let mut first = [0];
            if transport.socket().peek(&mut first).await? == 0 {
                return Err(AuthError::Disconnected(io::ErrorKind::UnexpectedEof.into()));
            }
            if !is_tls(&first) {
                return Err(AuthError::NotTls);
            }
        }
        let socket = self.thread.adopt(transport.socket())?;
        let (handshake_task, task_thread) =
            (handshake(self.tls.clone(), socket, role), self.thread.task_thread());
        let handshake_done =
            self.thread.runtime().spawn(by_turns(handshake_task, move || task_thread.end_turn()));
        let (tls, peer) = AbortOnDropHandle::new(handshake_done).await.map_err(io::Error::other)??;
        Ok((transport.encrypted(tls), peer))
    }
}

/// Runs `work`, and calls `end_turn` after each of its polls.
async fn by_turns<T>(work: impl Future<Output = T>, mut end_turn: impl FnMut()) -> T {
    let mut work = pin!(work);
    poll_fn(|cx| {
        let polled = work.as_mut().poll(cx);
        end_turn();
        polled
    })
    .await
}

async fn handshake(tls: Tls, socket: TcpStream, role: TlsRole) -> Result<(Connection, Box<Peer>), AuthError> {
    let connection: Connection = match role {
        TlsRole::Client => {
            let connector = TlsConnector::from(tls.client());
            connector.connect(Tls::server_name(), socket).await?.into_inner().1.into()
        }
        TlsRole::Server => TlsAcceptor::from(tls.server()).accept(socket).await?.into_inner().1.into(),
    };
    // The node that the dialler expects is compared with the actual one when HELLO arrives.
    let peer = tls.peer(&connection, None, UnixTime::now())?;
    Ok((connection, Box::new(peer)))
}

#[cfg(test)]
mod tests {
    use std::{cell::Cell, io::Write as _};

    use rustls::ClientConnection;

    use super::*;
    use sinew_security::testing::Authority;

    #[tokio::test]
    async fn abandoned_handshake_yields_the_cpu_after_its_cost() {
        const PATIENCE: Duration = Duration::from_secs(20);
        let tls = Authority::new("walker").tls("knee", 1);
        let authenticator = Authenticator::begin(tls.clone()).unwrap();
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let mut stranger = std::net::TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let mut beginning = Vec::new();
        let mut client = ClientConnection::new(tls.client(), Tls::server_name()).unwrap();
        client.write_tls(&mut beginning).unwrap();
        stranger.write_all(&beginning).unwrap();
        let (socket, _) = listener.accept().await.unwrap();
        let given_away = async {
            while authenticator.thread.turns() == 0 {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::select! {
            authenticated = authenticator.authenticate(Transport::plain(socket), TlsRole::Server) => panic!("{:?}", authenticated.map(drop)),
            looked = tokio::time::timeout(PATIENCE, given_away) => looked.expect("a turn of it has ended"),
        }
    }

    #[tokio::test]
    async fn each_handshake_step_is_a_turn_even_while_waiting() {
        let turns = Cell::new(0);
        let mut before = Vec::new();
        let work = async {
            for _ in 0..2 {
                before.push(turns.get());
                tokio::task::yield_now().await;
            }
            before.push(turns.get());
        };
        by_turns(work, || turns.set(turns.get() + 1)).await;
        assert_eq!((before, turns.get()), (vec![0, 1, 2], 3));
    }
}
