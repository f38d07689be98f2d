//! Connections and their limits. Each connection has one request. Everything that a client can send or hold has a
//! bound.

use std::{
    convert::Infallible,
    io,
    net::{IpAddr, SocketAddr, TcpListener},
    sync::Arc,
    time::Duration,
};

use http_body_util::Full;
use hyper::{
    Request, Response, StatusCode,
    body::{Body as _, Bytes, Incoming},
    header::{
        ALLOW, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderValue, X_CONTENT_TYPE_OPTIONS,
    },
    server::conn::http1,
    service::service_fn,
};
use hyper_util::rt::{TokioIo, TokioTimer};
use sinew::{Time, signals::StopSignals};
use tokio::{
    net::TcpStream,
    sync::Semaphore,
    time::{sleep, timeout},
};

use crate::{
    cache::{Cache, FRESH, Source},
    metrics, page,
    request::{self, Document, Head, RequestError},
};

/// Maximum number of connections at a time. Further ones wait until one ends.
const CONNECTIONS_MAX: usize = 64;
/// Maximum bytes of the first part of a request.
const HEAD_BYTES_MAX: usize = 8 * 1_024;
/// Maximum number of headers of a request.
const HEADERS_MAX: usize = 64;
/// Time limit for the first part of a request.
const HEAD_WITHIN: Duration = Duration::from_secs(5);
/// Time limit from the request to the begin of the answer.
const ANSWER_WITHIN: Duration = Duration::from_secs(5);
/// Time limit for a connection as a whole, also for a client that does not read.
const CONNECTION_WITHIN: Duration = Duration::from_secs(15);
/// Wait after a connection that could not be accepted, for example without free descriptors.
const ACCEPT_RETRY: Duration = Duration::from_millis(100);

/// A server that is bound and not running yet.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
}

struct Shared {
    cache: Cache,
    listens: IpAddr,
}

impl Server {
    /// Binds the server to this address; port 0 for any free one.
    ///
    /// # Errors
    /// The address is in use, or is none of this host, or its port needs rights.
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
        Ok(Self { listener, address })
    }

    /// Returns the address that it listens on.
    #[must_use]
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Answers requests until Ctrl-C or SIGTERM.
    ///
    /// # Errors
    /// The system gives no thread or no descriptor.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// use sinew::Time;
    /// use sinew_view::{Server, Snapshot, Source};
    ///
    /// struct Nothing;
    ///
    /// impl Source for Nothing {
    ///     fn snapshot(&mut self) -> Snapshot {
    ///         Snapshot::without_entry(Time::now(), "there is no node".to_owned())
    ///     }
    /// }
    ///
    /// Server::bind("127.0.0.1:9464".parse().expect("an address"))?.run(Nothing)?;
    /// # Ok::<(), std::io::Error>(())
    /// ```
    pub fn run(self, source: impl Source) -> io::Result<()> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        runtime.block_on(async {
            let listener = tokio::net::TcpListener::from_std(self.listener)?;
            let mut signals = StopSignals::listen()?;
            let cache = Cache::start(source, FRESH)?;
            let shared = Arc::new(Shared { cache, listens: self.address.ip() });
            tokio::select! {
                _ = signals.recv() => Ok(()),
                never = accept(&listener, &shared) => match never {},
            }
        })
    }
}

async fn accept(listener: &tokio::net::TcpListener, shared: &Arc<Shared>) -> Infallible {
    let slots = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    loop {
        let slot = Arc::clone(&slots).acquire_owned().await.expect("nothing closes the semaphore");
        match listener.accept().await {
            Ok((stream, _)) => {
                let shared = Arc::clone(shared);
                tokio::spawn(async move {
                    serve(stream, shared).await;
                    drop(slot);
                });
            }
            Err(_) => sleep(ACCEPT_RETRY).await,
        }
    }
}

/// Answers the request of a connection.
async fn serve(stream: TcpStream, shared: Arc<Shared>) {
    let service = service_fn(move |request: Request<Incoming>| {
        let shared = Arc::clone(&shared);
        async move { Ok::<_, Infallible>(answer(&request, &shared).await) }
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_WITHIN)
        .max_buf_size(HEAD_BYTES_MAX)
        .max_headers(HEADERS_MAX)
        .keep_alive(false)
        .serve_connection(TokioIo::new(stream), service);
    // An error is the client's, which sees it: a malformed request, or a connection that it has closed.
    let _ = timeout(CONNECTION_WITHIN, connection).await;
}

async fn answer(request: &Request<Incoming>, shared: &Shared) -> Response<Full<Bytes>> {
    let has_body = !request.body().is_end_stream();
    let head = Head { method: request.method(), uri: request.uri(), headers: request.headers(), has_body };
    let document = match request::document(head, shared.listens) {
        Ok(document) => document,
        Err(error) => return refused(error),
    };
    let Ok(Some(snapshot)) = timeout(ANSWER_WITHIN, shared.cache.snapshot()).await else {
        let why = format!("the nodes gave no answer within {ANSWER_WITHIN:?}; try again");
        return plain(StatusCode::SERVICE_UNAVAILABLE, why);
    };
    match document {
        Document::Page => {
            response(StatusCode::OK, "text/html; charset=utf-8", page::html(&snapshot, Time::now()))
        }
        Document::Metrics(format) => match metrics::encode(&snapshot, Time::now(), format) {
            Ok(text) => response(StatusCode::OK, format.content_type(), text),
            Err(_) => {
                plain(StatusCode::INTERNAL_SERVER_ERROR, "the metrics cannot be written as text".to_owned())
            }
        },
    }
}

fn refused(error: RequestError) -> Response<Full<Bytes>> {
    let mut response = plain(error.status(), error.to_string());
    if error == RequestError::Method {
        response.headers_mut().insert(ALLOW, HeaderValue::from_static("GET"));
    }
    response
}

fn plain(status: StatusCode, text: String) -> Response<Full<Bytes>> {
    response(status, "text/plain; charset=utf-8", text + "\n")
}

fn response(status: StatusCode, content_type: &'static str, text: String) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(Bytes::from(text)));
    *response.status_mut() = status;
    let headers = response.headers_mut();
    let fixed = [
        (CONTENT_TYPE, content_type),
        (CACHE_CONTROL, "no-store"),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (CONTENT_SECURITY_POLICY, "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"),
    ];
    for (name, value) in fixed {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}
