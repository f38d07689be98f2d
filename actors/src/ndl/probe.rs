//! Whether the host of a silent node is there: a connection is tried, at each of the addresses of its GNCL.
//!
//! A kernel accepts connections for a process that is stopped or hangs, refuses those to one that has ended, and says nothing where the
//! way is cut. No word is sent: the other side sees a connection that ends again.

use std::{
    io::{self, ErrorKind},
    net::SocketAddr,
    time::Duration,
};

use futures_util::{StreamExt as _, stream};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};
use tokio::{net::TcpStream, time::timeout};

use super::core::{Host, Input};

/// Hosts that are tried at once, at most, so that a cut network costs few descriptors. Whose host is not tried counts as out of reach with
/// it, as all the others are then.
pub(super) const PROBES_MAX: usize = 64;
/// Addresses of one host that are tried at once, at most: 512 descriptors for all hosts. Where as many say nothing, others are not tried.
const AT_ONCE_MAX: usize = 8;

/// Whose host is to be tried.
#[derive(Debug)]
pub(super) struct Probe {
    pub(super) node: NodeAddress,
    pub(super) incarnation: Incarnation,
    pub(super) to: Vec<SocketAddr>,
    pub(super) within: Duration,
    /// When that was to be known.
    pub(super) asked: Time,
}

impl Probe {
    /// Tries the addresses, the first ones at once; what the host said is known in time, whatever it is. It refuses only if it does so at
    /// each of them.
    pub(super) async fn carry_out(self) -> Input {
        let host = self.said_by(TcpStream::connect).await;
        let Self { node, incarnation, asked, .. } = self;
        Input::Probed { node, incarnation, host, asked }
    }

    async fn said_by<T>(&self, connect: impl Fn(SocketAddr) -> T) -> Host
    where
        T: Future<Output = io::Result<TcpStream>>,
    {
        let mut tries = stream::iter(&self.to).map(|to| connect(*to)).buffer_unordered(AT_ONCE_MAX);
        // Who has said nothing when the time is over is silent.
        let mut said = Vec::new();
        let all = async {
            while let Some(tried) = tries.next().await {
                said.push(match tried {
                    Ok(_) => Host::Accepts,
                    Err(error) if error.kind() == ErrorKind::ConnectionRefused => Host::Refuses,
                    // No way there, or no descriptor here: nothing is known of the host.
                    Err(_) => Host::IsSilent,
                });
                if said.contains(&Host::Accepts) {
                    return;
                }
            }
        };
        let has_ended = timeout(self.within, all).await;
        Host::by(said.into_iter().chain(has_ended.err().map(|_| Host::IsSilent)))
    }
}

#[cfg(test)]
mod tests {
    use std::{
        cell::RefCell,
        net::{Ipv4Addr, TcpListener},
    };

    use super::*;

    fn of(to: Vec<SocketAddr>, within: Duration) -> Probe {
        Probe { node: NodeAddress::new(1), incarnation: Incarnation(1), to, within, asked: Time::ZERO }
    }

    fn probe(to: Vec<SocketAddr>) -> Host {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(of(to, Duration::from_secs(5)).said_by(TcpStream::connect))
    }

    #[tokio::test]
    async fn of_addresses_that_say_nothing_a_few_are_tried_and_one_that_refuses_makes_room_for_the_next() {
        let to: Vec<SocketAddr> = (1..=20).map(|port| ([127, 0, 0, 1], port).into()).collect();
        let tried = RefCell::new(Vec::new());
        let connect = |at: SocketAddr| {
            tried.borrow_mut().push(at.port());
            async move {
                if at.port() == 2 {
                    return Err(ErrorKind::ConnectionRefused.into());
                }
                std::future::pending().await
            }
        };
        let host = of(to, Duration::ZERO).said_by(connect).await;
        assert_eq!(host, Host::IsSilent);
        assert!(tried.into_inner().into_iter().eq(1..=9));
    }

    /// What is said of a host when its first address, or whoever else has that, refuses, and this is what the second one does.
    async fn with_one_that_refuses<T>(second: impl Fn() -> T) -> Host
    where
        T: Future<Output = io::Result<TcpStream>>,
    {
        let to: Vec<SocketAddr> = vec![([172, 17, 0, 1], 5_000).into(), ([10, 0, 0, 2], 5_000).into()];
        let connect = |at: SocketAddr| {
            let (is_first, second) = (at == to[0], second());
            async move { if is_first { Err(ErrorKind::ConnectionRefused.into()) } else { second.await } }
        };
        of(to.clone(), Duration::ZERO).said_by(connect).await
    }

    // spec: NDL-4.6
    #[tokio::test]
    async fn a_host_refuses_only_if_it_does_at_each_of_its_addresses() {
        let refused = || async { Err(ErrorKind::ConnectionRefused.into()) };
        let unreachable = || async { Err(ErrorKind::HostUnreachable.into()) };
        assert_eq!(with_one_that_refuses(refused).await, Host::Refuses);
        assert_eq!(with_one_that_refuses(unreachable).await, Host::IsSilent);
        assert_eq!(with_one_that_refuses(std::future::pending).await, Host::IsSilent);
    }

    #[test]
    fn a_host_accepts_for_whoever_listens_without_ever_taking_and_refuses_where_nobody_does() {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let taken = listener.local_addr().unwrap();
        let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap().local_addr().unwrap();
        assert_eq!(probe(vec![taken]), Host::Accepts);
        assert_eq!(probe(vec![free]), Host::Refuses);
        assert_eq!(probe(vec![free, taken]), Host::Accepts, "one of its addresses is enough");
        assert_eq!(probe(vec![]), Host::IsSilent);
    }
}
