//! Checks requests. Any website can make a browser send requests to this host, by a name that it points here, or with
//! an address of this host. So only a request with a `Host` of this host is answered. All but the metrics need the
//! token, and one that asks the nodes or writes has to come from the page itself.

use std::net::IpAddr;

use hyper::{
    HeaderMap, Method, StatusCode, Uri,
    header::{ACCEPT, CONTENT_TYPE, HOST, ORIGIN},
    http::uri::Authority,
};

use crate::{
    assets::{self, Asset},
    auth::Token,
    look::Look,
    metrics::Format,
};

/// The site that sent a request, as browsers state it.
const FETCH_SITE: &str = "sec-fetch-site";

/// The first part of a request.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Head<'r> {
    pub(crate) method: &'r Method,
    pub(crate) uri: &'r Uri,
    pub(crate) headers: &'r HeaderMap,
    pub(crate) has_body: bool,
}

/// The server's own part of the checks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Access<'s> {
    /// The address that it listens on.
    pub(crate) listens: IpAddr,
    pub(crate) token: &'s Token,
    /// The name of the cookie with the token.
    pub(crate) cookie: &'s str,
}

/// The requested document or act.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Document {
    /// The metrics, which need no token.
    Metrics(Format),
    /// The page with a valid token in its address: the browser gets it as a cookie.
    Login,
    /// A file of the page.
    File(&'static Asset),
    /// The stream of a page.
    Stream(Look),
    /// The parameters of all applications.
    Parameters,
    /// A set of parameters: the body has it.
    Set,
    /// A press or a release of the stop: the body has it.
    Stop,
}

/// Why a request is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum RequestError {
    /// It has no valid `Host`, or several.
    #[error("the request needs one header Host; use HTTP/1.1")]
    NoHost,
    /// It is meant for another host.
    #[error("the request is for another host; use localhost or the address that sinew view listens on")]
    OtherHost,
    /// It has not the token.
    #[error("the page needs the token of this start; open the address that sinew view has printed")]
    NoToken,
    /// Another site has sent it.
    #[error("the request comes from another site; use the page of sinew view itself")]
    OtherSite,
    /// The path has another method.
    #[error("only {0} is answered here")]
    Method(&'static str),
    /// It has a body.
    #[error("a request has no body here; send it without one")]
    Body,
    /// Its body is no JSON.
    #[error("the body has to be JSON; set the header Content-Type to application/json")]
    NoJson,
    /// The query of a stream is illegal.
    #[error("the query is too long, names too much or has unknown parts; open fewer plots")]
    Query,
    /// It has not the token of the server for Foxglove.
    #[error(
        "this needs the token of this start; connect to the address that sinew view has printed for Foxglove"
    )]
    NoFoxgloveToken,
    /// It opens no WebSocket.
    #[error("this port is for WebSocket clients; connect Foxglove to it, or another client of its protocol")]
    NoWebSocket,
    /// It names no protocol of the server for Foxglove.
    #[error("the client names no protocol of this server; it has foxglove.websocket.v1 and foxglove.sdk.v1")]
    NoProtocol,
    /// There is no such document.
    #[error("there is no such page; try / or /metrics")]
    NoPage,
}

impl RequestError {
    pub(crate) const fn status(self) -> StatusCode {
        match self {
            Self::NoHost | Self::Query | Self::NoProtocol => StatusCode::BAD_REQUEST,
            Self::NoToken | Self::NoFoxgloveToken => StatusCode::UNAUTHORIZED,
            Self::NoWebSocket => StatusCode::UPGRADE_REQUIRED,
            Self::OtherHost | Self::OtherSite => StatusCode::FORBIDDEN,
            Self::Method(_) => StatusCode::METHOD_NOT_ALLOWED,
            Self::Body => StatusCode::PAYLOAD_TOO_LARGE,
            Self::NoJson => StatusCode::UNSUPPORTED_MEDIA_TYPE,
            Self::NoPage => StatusCode::NOT_FOUND,
        }
    }
}

/// Returns the requested document.
pub(crate) fn document(head: Head<'_>, access: Access<'_>) -> Result<Document, RequestError> {
    let host = check_host(head, access.listens)?;
    let path = head.uri.path();
    if path == "/metrics" {
        check_get(head)?;
        return Ok(Document::Metrics(format(head.headers)));
    }
    if path == "/" && has_token(head.uri.query(), access.token) {
        check_get(head)?;
        return Ok(Document::Login);
    }
    if !access.token.is_in(head.headers, access.cookie) {
        return Err(RequestError::NoToken);
    }
    // A request that asks the nodes comes from the page alone. Browsers send no `Origin` with most that only read.
    let writes = matches!(path, "/api/parameters" | "/api/stop") && *head.method == Method::POST;
    if path.starts_with("/api/") {
        check_site(head.headers, &host, writes)?;
    }
    match path {
        "/api/stream" => {
            check_get(head)?;
            let query = head.uri.query().unwrap_or_default();
            Look::of_query(query).map(Document::Stream).ok_or(RequestError::Query)
        }
        _ if writes => {
            if head.headers.get(CONTENT_TYPE).is_none_or(|found| found != "application/json") {
                return Err(RequestError::NoJson);
            }
            Ok(if path == "/api/stop" { Document::Stop } else { Document::Set })
        }
        "/api/stop" => Err(RequestError::Method("POST")),
        "/api/parameters" if *head.method != Method::GET => Err(RequestError::Method("GET, POST")),
        "/api/parameters" => {
            check_get(head)?;
            Ok(Document::Parameters)
        }
        _ => {
            let file = assets::find(path).ok_or(RequestError::NoPage)?;
            check_get(head)?;
            Ok(Document::File(file))
        }
    }
}

fn check_get(head: Head<'_>) -> Result<(), RequestError> {
    if *head.method != Method::GET {
        return Err(RequestError::Method("GET"));
    }
    if head.has_body { Err(RequestError::Body) } else { Ok(()) }
}

/// Returns whether the query of the page's address has the token.
fn has_token(query: Option<&str>, token: &Token) -> bool {
    query.and_then(|query| query.strip_prefix("token=")).is_some_and(|text| token.is(text))
}

/// Checks that the page itself has sent a request: by its `Origin`, which a browser sends with each request that
/// writes, and by the statement of newer browsers.
fn check_site(headers: &HeaderMap, host: &Authority, needs_origin: bool) -> Result<(), RequestError> {
    let own = format!("http://{host}");
    let mut origins = headers.get_all(ORIGIN).iter();
    let is_own = match (origins.next(), origins.next()) {
        (None, _) => !needs_origin,
        (Some(origin), None) => origin.as_bytes().eq_ignore_ascii_case(own.as_bytes()),
        (Some(_), Some(_)) => false,
    };
    let is_stated = headers.get(FETCH_SITE).is_none_or(|site| site == "same-origin");
    if is_own && is_stated { Ok(()) } else { Err(RequestError::OtherSite) }
}

/// Returns the host that the request is for.
pub(crate) fn check_host(head: Head<'_>, listens: IpAddr) -> Result<Authority, RequestError> {
    let mut hosts = head.headers.get_all(HOST).iter();
    let (Some(host), None) = (hosts.next(), hosts.next()) else { return Err(RequestError::NoHost) };
    let host = host.to_str().ok().and_then(|text| text.parse::<Authority>().ok());
    let host = host.ok_or(RequestError::NoHost)?;
    let is_own = |authority: &Authority| is_own_host(authority.host(), listens);
    if is_own(&host) && head.uri.authority().is_none_or(is_own) {
        return Ok(host);
    }
    Err(RequestError::OtherHost)
}

/// Returns whether this is a name or an address of the server. An address is never one of a website's names: all are
/// accepted by a server that listens on all of its host.
fn is_own_host(host: &str, listens: IpAddr) -> bool {
    if host.eq_ignore_ascii_case("localhost") {
        return true;
    }
    let bare = host.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(host);
    let Ok(address) = bare.parse::<IpAddr>() else { return false };
    address.is_loopback() || address == listens || listens.is_unspecified()
}

/// Returns the format that the client reads: OpenMetrics, unless it names the older one alone.
fn format(headers: &HeaderMap) -> Format {
    let accepted: Vec<_> = headers.get_all(ACCEPT).iter().filter_map(|value| value.to_str().ok()).collect();
    let names = |format: &str| accepted.iter().any(|value| value.contains(format));
    if names("text/plain") && !names("application/openmetrics-text") {
        return Format::PlainText;
    }
    Format::OpenMetrics
}

#[cfg(test)]
mod tests;
