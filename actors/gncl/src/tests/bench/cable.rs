//! A cable between a dialler and its target, which a test can cut.

use std::net::SocketAddr;

use tokio::{
    net::{TcpListener, TcpStream},
    task::JoinHandle,
};

/// The connections to cut: this one, by the order of their creation from 0, or all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cut {
    All,
    One(usize),
}

/// A cable between a dialler and `target` that can be cut.
pub(in crate::tests) struct Cable {
    pub(in crate::tests) address: SocketAddr,
    cut: tokio::sync::watch::Sender<(u64, Cut)>,
    accepting: JoinHandle<()>,
}

impl Cable {
    pub(in crate::tests) async fn to(target: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("loopback has a free port");
        let address = listener.local_addr().expect("it is bound");
        let (cut, cuts) = tokio::sync::watch::channel((0, Cut::All));
        let accepting = actix_rt::spawn(async move {
            let mut made = 0..;
            while let (Ok((mut near, _)), Some(number)) = (listener.accept().await, made.next()) {
                let mut cuts = cuts.clone();
                let before = cuts.borrow_and_update().0;
                let Ok(mut far) = TcpStream::connect(target).await else { continue };
                actix_rt::spawn(async move {
                    tokio::select! {
                        _ = tokio::io::copy_bidirectional(&mut near, &mut far) => {}
                        _ = cuts.wait_for(|(at, cut)| {
                            *at > before && matches!(*cut, Cut::All) || *cut == Cut::One(number)
                        }) => {}
                    }
                });
            }
        });
        Self { address, cut, accepting }
    }

    /// Ends all present connections.
    pub(in crate::tests) fn cut(&self) {
        self.cut.send_modify(|(at, cut)| (*at, *cut) = (*at + 1, Cut::All));
    }

    /// Makes the target unreachable through the cable.
    pub(in crate::tests) fn remove(&self) {
        self.accepting.abort();
    }

    /// Ends the connection with this number, by the order of their creation from 0.
    pub(in crate::tests) fn cut_one(&self, number: usize) {
        self.cut.send_modify(|(at, cut)| (*at, *cut) = (*at + 1, Cut::One(number)));
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.accepting.abort();
    }
}
