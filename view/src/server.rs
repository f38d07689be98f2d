//! Connections and their limits. Each connection has one request. Everything that a client can send or hold has a
//! bound.

use std::{
    convert::Infallible,
    future::pending,
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
    foxglove::{self, Hub, Reads, Writes},
    pages::{Pages, wall_s},
    source::Source,
    stream::Line,
};

/// Maximum number of connections at a time. Further ones wait until one ends.
const CONNECTIONS_MAX: usize = 64;
/// Maximum bytes of the first part of a request.
pub(crate) const HEAD_BYTES_MAX: usize = 8 * 1_024;
/// Maximum number of headers of a request.
pub(crate) const HEADERS_MAX: usize = 64;
/// Time limit for the first part of a request.
pub(crate) const HEAD_WITHIN: Duration = Duration::from_secs(5);
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
    foxglove: Option<Foxglove>,
}

/// The bound server for Foxglove.
#[derive(Debug)]
struct Foxglove {
    listener: TcpListener,
    own: foxglove::Identity,
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
        let (listener, address) = bind(address)?;
        Ok(Self { listener, address, token: Token::random()?, foxglove: None })
    }

    /// Binds a server for Foxglove to this port of the same address; port 0 for any free one. Returns its address, with
    /// the token of this start. It is a secret.
    ///
    /// # Errors
    /// As [`bind`](Self::bind).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew_view::{Reads, Server, Writes};
    ///
    /// let mut server = Server::bind("127.0.0.1:0".parse().expect("an address"))?;
    /// let address = server.bind_foxglove(0, Reads::WithToken, Writes::Refused)?;
    /// assert!(address.starts_with("ws://127.0.0.1:") && address.contains("/?token="));
    /// # Ok::<(), std::io::Error>(())
    /// ```
    pub fn bind_foxglove(&mut self, port: u16, reads: Reads, writes: Writes) -> io::Result<String> {
        let (listener, address) = bind(SocketAddr::new(self.address.ip(), port))?;
        let token = Token::random()?;
        let shown = format!("ws://{}/?token={}", reachable(address), token.text());
        let own = foxglove::Identity { listens: address.ip(), token, reads, writes };
        self.foxglove = Some(Foxglove { listener, own });
        Ok(shown)
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
        format!("http://{}/?token={}", reachable(self.address), self.token.text())
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
            let hub = self.foxglove.is_some().then(|| Hub::start(Arc::clone(&source), &session()));
            let hub = hub.transpose()?;
            let shared = Arc::new(Shared::new(source, cache, pages, hub.clone()));
            let cookie = auth::cookie_name(self.address.port());
            let own = Arc::new(Identity { listens: self.address.ip(), token: self.token, cookie });
            let for_pages = |stream| serve(stream, Arc::clone(&shared), Arc::clone(&own));
            let result = tokio::select! {
                _ = signals.recv() => Ok(()),
                never = accept(&listener, CONNECTIONS_MAX, for_pages) => match never {},
                why = accept_foxglove(self.foxglove, &shared, hub.as_ref()) => Err(why),
            };
            if let Some(hub) = hub {
                hub.end();
            }
            result
        });
        // A question to the nodes may still wait for its answer: the program does not.
        runtime.shutdown_background();
        result
    }
}

fn bind(address: SocketAddr) -> io::Result<(TcpListener, SocketAddr)> {
    let listener = TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    let address = listener.local_addr()?;
    Ok((listener, address))
}

/// Returns an address that a client of this host can open, which is no unspecified one.
fn reachable(mut address: SocketAddr) -> SocketAddr {
    if address.ip().is_unspecified() {
        let is_v4 = address.is_ipv4();
        address.set_ip(if is_v4 { Ipv4Addr::LOCALHOST.into() } else { Ipv6Addr::LOCALHOST.into() });
    }
    address
}

/// Returns a text that another start has not: Foxglove takes the same one for a connection that has come back.
fn session() -> String {
    format!("{:x}", (wall_s() * 1e3) as u64)
}

/// Accepts clients of Foxglove's protocol, if there is a server for them. It returns only if it cannot listen.
async fn accept_foxglove(server: Option<Foxglove>, shared: &Arc<Shared>, hub: Option<&Hub>) -> io::Error {
    let (Some(Foxglove { listener, own }), Some(hub)) = (server, hub) else { return pending().await };
    let listener = match tokio::net::TcpListener::from_std(listener) {
        Ok(listener) => listener,
        Err(why) => return why,
    };
    let own = Arc::new(own);
    let serve = |stream| foxglove::serve(stream, Arc::clone(shared), hub.clone(), Arc::clone(&own));
    match accept(&listener, foxglove::CONNECTIONS_MAX, serve).await {}
}

/// Serves each connection on a task of its own, as many at a time as there are slots.
async fn accept<F>(
    listener: &tokio::net::TcpListener,
    slots: usize,
    serve: impl Fn(TcpStream) -> F,
) -> Infallible
where
    F: Future<Output = ()> + Send + 'static,
{
    let slots = Arc::new(Semaphore::new(slots));
    loop {
        let slot = Arc::clone(&slots).acquire_owned().await.expect("nothing closes the semaphore");
        match listener.accept().await {
            Ok((stream, _)) => {
                let served = serve(stream);
                tokio::spawn(async move {
                    served.await;
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
