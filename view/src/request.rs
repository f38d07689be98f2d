//! Checks requests. Any website can make a browser send requests to this host, by a name that it points here. So only
//! a request with a `Host` of this host is answered.

use std::net::IpAddr;

use hyper::{
    HeaderMap, Method, StatusCode, Uri,
    header::{ACCEPT, HOST},
    http::uri::Authority,
};

use crate::metrics::Format;

/// The first part of a request.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Head<'r> {
    pub(crate) method: &'r Method,
    pub(crate) uri: &'r Uri,
    pub(crate) headers: &'r HeaderMap,
    pub(crate) has_body: bool,
}

/// The requested document.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Document {
    Metrics(Format),
    Page,
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
    /// It would change something.
    #[error("only GET is answered")]
    Method,
    /// It has a body.
    #[error("a request has no body here; send it without one")]
    Body,
    /// There is no such document.
    #[error("there is no such page; try / or /metrics")]
    NoPage,
}

impl RequestError {
    pub(crate) const fn status(self) -> StatusCode {
        match self {
            Self::NoHost => StatusCode::BAD_REQUEST,
            Self::OtherHost => StatusCode::FORBIDDEN,
            Self::Method => StatusCode::METHOD_NOT_ALLOWED,
            Self::Body => StatusCode::PAYLOAD_TOO_LARGE,
            Self::NoPage => StatusCode::NOT_FOUND,
        }
    }
}

/// Returns the requested document, for a server that listens on this address.
pub(crate) fn document(head: Head<'_>, listens: IpAddr) -> Result<Document, RequestError> {
    check_host(head, listens)?;
    if head.method != Method::GET {
        return Err(RequestError::Method);
    }
    if head.has_body {
        return Err(RequestError::Body);
    }
    match head.uri.path() {
        "/metrics" => Ok(Document::Metrics(format(head.headers))),
        "/" => Ok(Document::Page),
        _ => Err(RequestError::NoPage),
    }
}

fn check_host(head: Head<'_>, listens: IpAddr) -> Result<(), RequestError> {
    let mut hosts = head.headers.get_all(HOST).iter();
    let (Some(host), None) = (hosts.next(), hosts.next()) else { return Err(RequestError::NoHost) };
    let host = host.to_str().ok().and_then(|text| text.parse::<Authority>().ok());
    let host = host.ok_or(RequestError::NoHost)?;
    let is_own = |authority: &Authority| is_own_host(authority.host(), listens);
    if is_own(&host) && head.uri.authority().is_none_or(is_own) {
        return Ok(());
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
mod tests {
    use std::net::{Ipv4Addr, Ipv6Addr};

    use hyper::{Request, header::HeaderName};

    use super::*;

    const LOOPBACK: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

    fn asked(
        method: Method,
        uri: &str,
        headers: &[(HeaderName, &str)],
        listens: IpAddr,
    ) -> Result<Document, RequestError> {
        let mut request = Request::builder().method(method).uri(uri);
        for (name, value) in headers {
            request = request.header(name, *value);
        }
        let request = request.body(()).expect("a valid request");
        let (method, uri, headers) = (request.method(), request.uri(), request.headers());
        document(Head { method, uri, headers, has_body: false }, listens)
    }

    fn from_host(host: &str, listens: IpAddr) -> Result<Document, RequestError> {
        asked(Method::GET, "/", &[(HOST, host)], listens)
    }

    #[test]
    fn only_requests_for_this_host_are_answered() {
        for host in ["localhost", "LOCALHOST:9464", "127.0.0.1:9464", "127.0.0.9", "[::1]:9464", "[::1]"] {
            assert_eq!(from_host(host, LOOPBACK), Ok(Document::Page), "{host}");
        }
        for host in ["evil.example", "localhost.evil.example:9464", "10.0.0.1", "127.0.0.1.evil.example"] {
            assert_eq!(from_host(host, LOOPBACK), Err(RequestError::OtherHost), "{host}");
        }
        for host in ["", "a b", "[::1"] {
            assert_eq!(from_host(host, LOOPBACK), Err(RequestError::NoHost), "{host:?}");
        }
    }

    #[test]
    fn listened_address_is_a_host_and_no_name_is() {
        let listens = IpAddr::from([10, 0, 0, 1]);
        assert_eq!(from_host("10.0.0.1:9464", listens), Ok(Document::Page));
        assert_eq!(from_host("10.0.0.2:9464", listens), Err(RequestError::OtherHost));
        for listens in [IpAddr::V4(Ipv4Addr::UNSPECIFIED), IpAddr::V6(Ipv6Addr::UNSPECIFIED)] {
            assert_eq!(from_host("10.0.0.2:9464", listens), Ok(Document::Page));
            assert_eq!(from_host("robot.example:9464", listens), Err(RequestError::OtherHost));
        }
    }

    #[test]
    fn host_is_required_once_also_for_full_address() {
        assert_eq!(asked(Method::GET, "/", &[], LOOPBACK), Err(RequestError::NoHost));
        let two = [(HOST, "localhost"), (HOST, "evil.example")];
        assert_eq!(asked(Method::GET, "/", &two, LOOPBACK), Err(RequestError::NoHost));
        let full = asked(Method::GET, "http://evil.example/", &[(HOST, "localhost")], LOOPBACK);
        assert_eq!(full, Err(RequestError::OtherHost));
    }

    #[test]
    fn each_page_has_its_path_and_others_are_refused() {
        let own = [(HOST, "localhost")];
        let open = Ok(Document::Metrics(Format::OpenMetrics));
        assert_eq!(asked(Method::GET, "/metrics?x=1", &own, LOOPBACK), open);
        for path in ["/metrics/", "/favicon.ico", "//", "/../metrics"] {
            assert_eq!(asked(Method::GET, path, &own, LOOPBACK), Err(RequestError::NoPage), "{path}");
        }
        for method in [Method::POST, Method::PUT, Method::DELETE, Method::OPTIONS, Method::HEAD] {
            assert_eq!(asked(method, "/metrics", &own, LOOPBACK), Err(RequestError::Method));
        }
        let headers = HeaderMap::from_iter([(HOST, "localhost".parse().expect("a valid value"))]);
        let with_body =
            Head { method: &Method::GET, uri: &Uri::from_static("/"), headers: &headers, has_body: true };
        assert_eq!(document(with_body, LOOPBACK), Err(RequestError::Body));
    }

    #[test]
    fn older_format_is_for_clients_that_name_it_alone() {
        let format =
            |accept: &str| asked(Method::GET, "/metrics", &[(HOST, "localhost"), (ACCEPT, accept)], LOOPBACK);
        let prometheus =
            "application/openmetrics-text;version=1.0.0;q=0.5,text/plain;version=0.0.4;q=0.2,*/*;q=0.1";
        for accept in ["*/*", "application/openmetrics-text", prometheus] {
            assert_eq!(format(accept), Ok(Document::Metrics(Format::OpenMetrics)), "{accept}");
        }
        assert_eq!(format("text/plain;version=0.0.4"), Ok(Document::Metrics(Format::PlainText)));
    }
}
