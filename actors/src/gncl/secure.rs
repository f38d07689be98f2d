//! Who is at the other end, proven before a word is believed: the handshake of TLS on a connection between nodes.
//!
//! It takes a fraction of a millisecond of a CPU, and whoever can reach the port can ask for one: so it is a thread of its own that does
//! it, nicer than those that carry messages, and it gives its CPU away after each [`RUN`]. Being nicer is not enough: the system lets who
//! computes go on to the end of a slice of milliseconds, whoever has been woken meanwhile.

use std::{fmt, future::poll_fn, io, pin::pin, time::Duration};

use rustls::{Connection, pki_types::UnixTime};
use tokio::net::TcpStream;
use tokio_rustls::{TlsAcceptor, TlsConnector};
use tokio_util::task::AbortOnDropHandle;

use super::{bulk::BulkThread, courtesy::Courtesy, transport::Transport};
use crate::security::{Peer, PeerFault, Tls, words};

/// How a connection begins on which TLS is spoken: the type of its first record, which is no frame's first byte.
const HANDSHAKE_RECORD: u8 = 0x16;
/// How long the thread computes between two times that it gives its CPU away: two or three steps of handshakes, and less than others wait for a slice of it.
const RUN: Duration = Duration::from_millis(1);

/// What a node without keys says to one that has them.
pub(super) const SEALED_WORDS: &str = "you speak TLS, and this node has no keys: it is open to everybody on its network; give it those of your project \
     (`security.keys`, `sinew keys issue`), or take [security] from your configuration";
/// What a node with keys says to one that has none.
const OPEN_WORDS: &str = "this node takes only who proves with keys of its project who it is, and you do not speak TLS: give your node such keys \
     (`security.keys`, `sinew keys issue`)";

/// Whether a stranger's first bytes are those of TLS.
pub(super) fn is_sealed(bytes: &[u8]) -> bool {
    bytes.first() == Some(&HANDSHAKE_RECORD)
}

/// Which end of a connection this node is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum End {
    Dials,
    IsDialled,
}

/// Why it is not proven who is there.
#[derive(Debug)]
pub(super) enum Unproven {
    /// The connection ended before it was.
    Ended(io::Error),
    /// In words.
    NotTaken(String),
    /// The other end speaks without TLS, and reads what is said so.
    IsOpen,
}

impl fmt::Display for Unproven {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Ended(error) => error.fmt(f),
            Self::NotTaken(why) => f.write_str(why),
            Self::IsOpen => f.write_str(OPEN_WORDS),
        }
    }
}

impl From<io::Error> for Unproven {
    fn from(error: io::Error) -> Self {
        match error.get_ref().and_then(|inner| inner.downcast_ref::<rustls::Error>()) {
            Some(fault) => Self::NotTaken(words(fault)),
            None => Self::Ended(error),
        }
    }
}

impl From<PeerFault> for Unproven {
    fn from(fault: PeerFault) -> Self {
        Self::NotTaken(fault.to_string())
    }
}

impl From<Unproven> for io::Error {
    fn from(unproven: Unproven) -> Self {
        match unproven {
            Unproven::Ended(error) => error,
            why @ (Unproven::NotTaken(_) | Unproven::IsOpen) => {
                Self::new(io::ErrorKind::InvalidData, why.to_string())
            }
        }
    }
}

/// Both ends of a secured node's connections, and the thread of their handshakes, which ends with this.
pub(super) struct Secure {
    tls: Tls,
    thread: BulkThread,
}

impl Secure {
    /// # Errors
    /// The system gives no thread, or no descriptors for its reactor.
    pub(super) fn begin(tls: Tls) -> io::Result<Self> {
        Ok(Self { tls, thread: BulkThread::begin("handshakes", Courtesy::after_runs_of(RUN))? })
    }

    /// Has both ends prove who they are. Takes as long as the other end: whoever waits gives it up.
    pub(super) async fn greet(
        &self,
        transport: Transport,
        end: End,
    ) -> Result<(Transport, Box<Peer>), Unproven> {
        if end == End::IsDialled {
            let mut first = [0];
            if transport.socket().peek(&mut first).await? == 0 {
                return Err(Unproven::Ended(io::ErrorKind::UnexpectedEof.into()));
            }
            if !is_sealed(&first) {
                return Err(Unproven::IsOpen);
            }
        }
        let socket = self.thread.adopt(transport.socket())?;
        let (shaking, place) = (shake(self.tls.clone(), socket, end), self.thread.place());
        let shaken = self.thread.runtime().spawn(by_turns(shaking, move || place.end_turn()));
        let (tls, peer) = AbortOnDropHandle::new(shaken).await.map_err(io::Error::other)??;
        Ok((transport.sealed(tls), peer))
    }
}

/// The same, and after each turn of it this.
async fn by_turns<T>(work: impl Future<Output = T>, mut end_turn: impl FnMut()) -> T {
    let mut work = pin!(work);
    poll_fn(|cx| {
        let polled = work.as_mut().poll(cx);
        end_turn();
        polled
    })
    .await
}

async fn shake(tls: Tls, socket: TcpStream, end: End) -> Result<(Connection, Box<Peer>), Unproven> {
    let connection: Connection = match end {
        End::Dials => {
            let connector = TlsConnector::from(tls.client());
            connector.connect(Tls::server_name(), socket).await?.into_inner().1.into()
        }
        End::IsDialled => TlsAcceptor::from(tls.server()).accept(socket).await?.into_inner().1.into(),
    };
    // Whom the dialler wanted, and who is there, is compared when it says hello.
    let peer = tls.peer(&connection, None, UnixTime::now())?;
    Ok((connection, Box::new(peer)))
}

#[cfg(test)]
mod tests {
    use std::{cell::Cell, io::Write as _};

    use rustls::ClientConnection;

    use super::*;
    use crate::security::tests::ground::Authority;

    #[tokio::test]
    async fn the_cpu_is_given_away_after_what_a_handshake_that_nobody_ends_has_cost() {
        const PATIENCE: Duration = Duration::from_secs(20);
        let tls = Authority::new("walker").tls("knee", 1);
        let secure = Secure::begin(tls.clone()).unwrap();
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let mut stranger = std::net::TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let mut beginning = Vec::new();
        let mut client = ClientConnection::new(tls.client(), Tls::server_name()).unwrap();
        client.write_tls(&mut beginning).unwrap();
        stranger.write_all(&beginning).unwrap();
        let (socket, _) = listener.accept().await.unwrap();
        let given_away = async {
            while secure.thread.turns() == 0 {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::select! {
            greeted = secure.greet(Transport::open(socket), End::IsDialled) => panic!("{:?}", greeted.map(drop)),
            looked = tokio::time::timeout(PATIENCE, given_away) => looked.expect("a turn of it has ended"),
        }
    }

    #[tokio::test]
    async fn each_step_of_a_handshake_is_a_turn_also_of_one_that_waits_for_the_other_end() {
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
