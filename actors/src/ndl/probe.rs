//! Whether the host of a silent node is there: a connection is tried, at each of the addresses of its GNCL.
//!
//! A kernel accepts connections for a process that is stopped or hangs, refuses those to one that has ended, and says nothing where the
//! way is cut. No word is sent: the other side sees a connection that ends again.

use std::{io::ErrorKind, net::SocketAddr, time::Duration};

use futures_util::{StreamExt as _, stream::FuturesUnordered};
use sinew_runtime::tid::{Incarnation, NodeAddress};
use tokio::{net::TcpStream, time::timeout};

use super::core::Host;

/// Hosts that are tried at once, at most, so that a cut network costs few descriptors. Whose host is not tried counts as out of reach with
/// it, as all the others are then.
pub(super) const PROBES_MAX: usize = 64;

/// Whose host is to be tried.
#[derive(Debug)]
pub(super) struct Probe {
    pub(super) node: NodeAddress,
    pub(super) incarnation: Incarnation,
    pub(super) to: Vec<SocketAddr>,
    pub(super) within: Duration,
}

impl Probe {
    /// Tries all addresses at once; what the host said is known in time, whatever it is.
    pub(super) async fn carry_out(self) -> (NodeAddress, Incarnation, Host) {
        let mut tries: FuturesUnordered<_> = self.to.iter().map(TcpStream::connect).collect();
        let mut host = Host::IsSilent;
        let all = async {
            while let Some(tried) = tries.next().await {
                match tried {
                    Ok(_) => return host = Host::Accepts,
                    Err(error) if error.kind() == ErrorKind::ConnectionRefused => host = Host::Refuses,
                    // No way there, or no descriptor here: nothing is known of the host.
                    Err(_) => {}
                }
            }
        };
        // What was said before the time was over counts.
        let _ = timeout(self.within, all).await;
        (self.node, self.incarnation, host)
    }
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, TcpListener};

    use super::*;

    fn probe(to: Vec<SocketAddr>) -> Host {
        let probe = Probe {
            node: NodeAddress::new(1),
            incarnation: Incarnation(1),
            to,
            within: Duration::from_secs(5),
        };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(probe.carry_out()).2
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
