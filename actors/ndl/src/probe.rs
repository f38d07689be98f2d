//! Probes the host of a silent node by connecting to each address of its GNCL.
//!
//! A kernel accepts connections for a process that is stopped or hangs, and refuses those to one that has
//! ended. If the network path is cut, there is no response. The probe sends no data: the other side sees a
//! connection that closes again.

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

/// Maximum number of hosts that are probed at once, so that a cut network costs few descriptors. A host that
/// is not probed counts as unreachable, as all the others are then.
pub(super) const PROBES_MAX: usize = 64;
/// Maximum number of addresses of one host that are probed at once: 512 descriptors for all hosts. If that
/// many do not respond, the others are not probed.
const AT_ONCE_MAX: usize = 8;

/// A host to probe.
#[derive(Debug)]
pub(super) struct Probe {
    pub(super) node: NodeAddress,
    pub(super) incarnation: Incarnation,
    pub(super) to: Vec<SocketAddr>,
    pub(super) within: Duration,
    /// Time at which the probe was requested.
    pub(super) requested: Time,
}

impl Probe {
    /// Probes the addresses, the first ones at once. The result is known in time in every case. The host
    /// refuses only if each of its addresses does.
    pub(super) async fn run(self) -> Input {
        let host = self.response_by(TcpStream::connect).await;
        let Self { node, incarnation, requested, .. } = self;
        Input::Probed { node, incarnation, host, requested }
    }

    async fn response_by<T>(&self, connect: impl Fn(SocketAddr) -> T) -> Host
    where
        T: Future<Output = io::Result<TcpStream>>,
    {
        let mut tries = stream::iter(&self.to).map(|to| connect(*to)).buffer_unordered(AT_ONCE_MAX);
        // An address without a result at the deadline is silent.
        let mut responses = Vec::new();
        let all = async {
            while let Some(tried) = tries.next().await {
                responses.push(match tried {
                    Ok(_) => Host::Accepts,
                    Err(error) if error.kind() == ErrorKind::ConnectionRefused => Host::Refuses,
                    // There is no route, or no local descriptor: the state of the host is unknown.
                    Err(_) => Host::IsSilent,
                });
                if responses.contains(&Host::Accepts) {
                    return;
                }
            }
        };
        let has_ended = timeout(self.within, all).await;
        Host::by(responses.into_iter().chain(has_ended.err().map(|_| Host::IsSilent)))
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
        Probe { node: NodeAddress::new(1), incarnation: Incarnation(1), to, within, requested: Time::ZERO }
    }

    fn probe(to: Vec<SocketAddr>) -> Host {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(of(to, Duration::from_secs(5)).response_by(TcpStream::connect))
    }

    #[tokio::test]
    async fn silent_addresses_are_tried_a_few_at_a_time() {
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
        let host = of(to, Duration::ZERO).response_by(connect).await;
        assert_eq!(host, Host::IsSilent);
        assert!(tried.into_inner().into_iter().eq(1..=9));
    }

    /// Returns the classification of a host if its first address, or another host with that address, refuses, and the
    /// second one does this.
    async fn with_one_that_refuses<T>(second: impl Fn() -> T) -> Host
    where
        T: Future<Output = io::Result<TcpStream>>,
    {
        let to: Vec<SocketAddr> = vec![([172, 17, 0, 1], 5_000).into(), ([10, 0, 0, 2], 5_000).into()];
        let connect = |at: SocketAddr| {
            let (is_first, second) = (at == to[0], second());
            async move { if is_first { Err(ErrorKind::ConnectionRefused.into()) } else { second.await } }
        };
        of(to.clone(), Duration::ZERO).response_by(connect).await
    }

    // spec: NDL-4.6
    #[tokio::test]
    async fn host_refuses_only_if_each_of_its_addresses_does() {
        let refused = || async { Err(ErrorKind::ConnectionRefused.into()) };
        let unreachable = || async { Err(ErrorKind::HostUnreachable.into()) };
        assert_eq!(with_one_that_refuses(refused).await, Host::Refuses);
        assert_eq!(with_one_that_refuses(unreachable).await, Host::IsSilent);
        assert_eq!(with_one_that_refuses(std::future::pending).await, Host::IsSilent);
    }

    #[test]
    fn host_accepts_for_a_listener_that_never_accepts() {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let taken = listener.local_addr().unwrap();
        let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap().local_addr().unwrap();
        assert_eq!(probe(vec![taken]), Host::Accepts);
        assert_eq!(probe(vec![free]), Host::Refuses);
        assert_eq!(probe(vec![free, taken]), Host::Accepts, "one of its addresses is enough");
        assert_eq!(probe(vec![]), Host::IsSilent);
    }
}
