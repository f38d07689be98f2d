//! A server for Foxglove and other clients of its protocol, on a port of its own.
//!
//! ```text
//! client ── subscribe ──► Place ──► Hub ◄── thread `foxglove` ──► Live::poll
//!        ◄── views ────── Queues ◄──┘
//!        ── setParameters ──► parameters ──► Source::set
//! ```
//!
//! | module | content |
//! | --- | --- |
//! | `handshake` | which request opens a connection |
//! | `protocol` | the messages of the protocol |
//! | `channels` | the channels and their numbers |
//! | `hub` | clients, subscriptions, queues, counters, and the thread that reads messages |
//! | `client` | the connection of one client |
//! | `parameters` | parameters of all applications under names of one server |

mod channels;
mod client;
mod handshake;
mod hub;
mod parameters;
mod protocol;

use std::{
    convert::Infallible,
    net::IpAddr,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use hyper::{
    Request, Response, StatusCode,
    body::{Body as _, Bytes, Incoming},
    header::{CONNECTION, HeaderValue, SEC_WEBSOCKET_ACCEPT, SEC_WEBSOCKET_PROTOCOL, UPGRADE},
    server::conn::http1,
    service::service_fn,
    upgrade::OnUpgrade,
};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::{net::TcpStream, time::timeout};

pub(crate) use self::hub::{Counts, Hub};
use crate::{
    answer::{self, Shared},
    auth::Token,
    body::Content,
    request::Head,
    server::{HEAD_BYTES_MAX, HEAD_WITHIN, HEADERS_MAX},
};

/// Connections at a time, also those that have not become clients yet. Further ones wait until one ends.
pub(crate) const CONNECTIONS_MAX: usize = 2 * hub::CLIENTS_MAX;
/// Time limit for the request and its answer.
const OPENED_WITHIN: Duration = Duration::from_secs(5);

/// The clients that may read messages and parameters.
///
/// # Examples
///
/// ```
/// use sinew_view::{Reads, Server, Writes};
///
/// let mut server = Server::bind("127.0.0.1:0".parse().expect("an address"))?;
/// server.bind_foxglove(0, Reads::OnThisHost, Writes::Refused)?;
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Reads {
    /// Those with the token.
    #[default]
    WithToken,
    /// Also programs that connect over loopback without a token, and set nothing. Pages of browsers need it.
    OnThisHost,
}

/// Whether clients with the token may set parameters.
///
/// # Examples
///
/// ```
/// use sinew_view::{Reads, Server, Writes};
///
/// let mut server = Server::bind("127.0.0.1:0".parse().expect("an address"))?;
/// let address = server.bind_foxglove(0, Reads::default(), Writes::Allowed)?;
/// assert!(address.starts_with("ws://127.0.0.1:"));
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Writes {
    /// Their sets are refused.
    #[default]
    Refused,
    /// The application's node decides, as about sets of the page.
    Allowed,
}

/// The server's own address, token and rights.
#[derive(Debug)]
pub(crate) struct Identity {
    pub(crate) listens: IpAddr,
    pub(crate) token: Token,
    pub(crate) reads: Reads,
    pub(crate) writes: Writes,
}

/// Serves a connection: its request, and then the client.
pub(crate) async fn serve(stream: TcpStream, shared: Arc<Shared>, hub: Hub, own: Arc<Identity>) {
    let opened = Arc::new(Mutex::new(None));
    let (of, identity) = (Arc::clone(&opened), Arc::clone(&own));
    let is_local = stream.peer_addr().is_ok_and(|peer| peer.ip().to_canonical().is_loopback());
    let service = service_fn(move |request: Request<Incoming>| {
        let (response, accepted) = open(request, &identity, is_local);
        if accepted.is_some() {
            *of.lock().unwrap_or_else(PoisonError::into_inner) = accepted;
        }
        async move { Ok::<_, Infallible>(response) }
    });
    // Small messages leave at once.
    let _ = stream.set_nodelay(true);
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_WITHIN)
        .max_buf_size(HEAD_BYTES_MAX)
        .max_headers(HEADERS_MAX)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    // An error is the client's, which sees it.
    let _ = timeout(OPENED_WITHIN, connection).await;
    let opened: Option<(OnUpgrade, Writes)> = opened.lock().unwrap_or_else(PoisonError::into_inner).take();
    let Some((upgrade, writes)) = opened else { return };
    if let Ok(Ok(upgraded)) = timeout(OPENED_WITHIN, upgrade).await {
        client::serve(TokioIo::new(upgraded), shared, hub, writes).await;
    }
}

/// Answers the request of a connection. An accepted one becomes a client with these rights.
fn open(
    mut request: Request<Incoming>,
    own: &Identity,
    is_local: bool,
) -> (Response<Content>, Option<(OnUpgrade, Writes)>) {
    let has_body = !request.body().is_end_stream();
    let head = Head { method: request.method(), uri: request.uri(), headers: request.headers(), has_body };
    let accepted = match handshake::check(head, own, is_local) {
        Ok(accepted) => accepted,
        Err(error) => {
            let mut response = answer::refused(error);
            response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
            return (response, None);
        }
    };
    let mut response = Response::new(Content::whole(Bytes::new()));
    *response.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
    let headers = response.headers_mut();
    headers.insert(UPGRADE, HeaderValue::from_static("websocket"));
    headers.insert(CONNECTION, HeaderValue::from_static("Upgrade"));
    headers.insert(SEC_WEBSOCKET_PROTOCOL, HeaderValue::from_static(accepted.protocol));
    // The proof is base64, which any header may have.
    if let Ok(proof) = HeaderValue::from_str(&accepted.proof) {
        headers.insert(SEC_WEBSOCKET_ACCEPT, proof);
    }
    (response, Some((hyper::upgrade::on(&mut request), accepted.writes)))
}
