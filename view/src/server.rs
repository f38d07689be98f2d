//! Connections and their limits. Each connection has one request. Everything that a client can send or hold has a
//! bound.

use std::{
    convert::Infallible,
    io,
    net::{Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener},
    pin::pin,
    sync::Arc,
    time::Duration,
};

use hyper::{Request, body::Incoming, server::conn::http1, service::service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use sinew::signals::StopSignals;
use tokio::{net::TcpStream, sync::Semaphore, time::sleep};

use crate::{
    answer::{self, Identity, Shared},
    auth::{self, Token},
    cache::{Cache, PAGE_FRESH},
    events::EventLog,
    pages::Pages,
    source::Source,
    stream::Line,
};

/// Maximum number of connections at a time. Further ones wait until one ends.
const CONNECTIONS_MAX: usize = 64;
/// Maximum bytes of the first part of a request.
const HEAD_BYTES_MAX: usize = 8 * 1_024;
/// Maximum number of headers of a request.
const HEADERS_MAX: usize = 64;
/// Time limit for the first part of a request.
const HEAD_WITHIN: Duration = Duration::from_secs(5);
/// Time limit for a connection as a whole, also for a client that does not read. A stream has another one: that of its
/// reader.
const CONNECTION_WITHIN: Duration = Duration::from_secs(15);
/// Wait after a connection that could not be accepted, for example without free descriptors.
const ACCEPT_RETRY: Duration = Duration::from_millis(100);

/// A server that is bound and not running yet.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    token: Token,
}

impl Server {
    /// Binds the server to this address; port 0 for any free one.
    ///
    /// # Errors
    /// The address is in use, or is none of this host, or its port needs rights; or the system gives no random bytes.
    ///
    /// # Examples
    ///
    /// ```
    /// let server = sinew_view::Server::bind("127.0.0.1:0".parse().expect("an address"))?;
    /// assert_ne!(server.address().port(), 0);
    /// # Ok::<(), std::io::Error>(())
    /// ```
    pub fn bind(address: SocketAddr) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        Ok(Self { listener, address, token: Token::random()? })
    }

    /// Returns the address that it listens on.
    #[must_use]
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Returns the address of the page, with the token of this start. It is a secret.
    ///
    /// # Examples
    ///
    /// ```
    /// let server = sinew_view::Server::bind("127.0.0.1:0".parse().expect("an address"))?;
    /// assert!(server.page().starts_with(&format!("http://{}/?token=", server.address())));
    /// # Ok::<(), std::io::Error>(())
    /// ```
    #[must_use]
    pub fn page(&self) -> String {
        let mut address = self.address;
        // A browser opens no unspecified address.
        if address.ip().is_unspecified() {
            let is_v4 = address.is_ipv4();
            address.set_ip(if is_v4 { Ipv4Addr::LOCALHOST.into() } else { Ipv6Addr::LOCALHOST.into() });
        }
        format!("http://{address}/?token={}", self.token.text())
    }

    /// Answers requests until Ctrl-C or SIGTERM.
    ///
    /// # Errors
    /// The system gives no thread or no descriptor.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew_view::{NoSystem, Server};
    ///
    /// Server::bind("127.0.0.1:9464".parse().expect("an address"))?.run(NoSystem)?;
    /// # Ok::<(), std::io::Error>(())
    /// ```
    pub fn run(self, source: impl Source) -> io::Result<()> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let result: io::Result<()> = runtime.block_on(async {
            let listener = tokio::net::TcpListener::from_std(self.listener)?;
            let mut signals = StopSignals::listen()?;
            let source: Arc<dyn Source> = Arc::new(source);
            let cache = Cache::start(Arc::clone(&source), PAGE_FRESH)?;
            let pages = Pages::start(Arc::clone(&source))?;
            let shared = Arc::new(Shared::new(source, cache, pages, EventLog::default()));
            let cookie = auth::cookie_name(self.address.port());
            let own = Arc::new(Identity { listens: self.address.ip(), token: self.token, cookie });
            tokio::select! {
                _ = signals.recv() => Ok(()),
                never = accept(&listener, &shared, &own) => match never {},
            }
        });
        // A question to the nodes may still wait for its answer: the program does not.
        runtime.shutdown_background();
        result
    }
}

async fn accept(listener: &tokio::net::TcpListener, shared: &Arc<Shared>, own: &Arc<Identity>) -> Infallible {
    let slots = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    loop {
        let slot = Arc::clone(&slots).acquire_owned().await.expect("nothing closes the semaphore");
        match listener.accept().await {
            Ok((stream, _)) => {
                let (shared, own) = (Arc::clone(shared), Arc::clone(own));
                tokio::spawn(async move {
                    serve(stream, shared, own).await;
                    drop(slot);
                });
            }
            Err(_) => sleep(ACCEPT_RETRY).await,
        }
    }
}

/// Answers the request of a connection.
async fn serve(stream: TcpStream, shared: Arc<Shared>, own: Arc<Identity>) {
    let line = Arc::new(Line::default());
    let of = Arc::clone(&line);
    let service = service_fn(move |request: Request<Incoming>| {
        let (shared, own, line) = (Arc::clone(&shared), Arc::clone(&own), Arc::clone(&of));
        async move { Ok::<_, Infallible>(answer::answer(request, &shared, (&*own, &line)).await) }
    });
    // Small events leave at once.
    let _ = stream.set_nodelay(true);
    let mut connection = pin!(
        http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(HEAD_WITHIN)
            .max_buf_size(HEAD_BYTES_MAX)
            .max_headers(HEADERS_MAX)
            .keep_alive(false)
            .serve_connection(TokioIo::new(stream), service)
    );
    // An error is the client's, which sees it: a malformed request, or a connection that it has closed.
    tokio::select! {
        _ = &mut connection => return,
        () = sleep(CONNECTION_WITHIN) => {}
        () = line.cut() => return,
    }
    if line.is_stream() {
        tokio::select! {
            _ = &mut connection => {}
            () = line.cut() => {}
        }
    }
}
