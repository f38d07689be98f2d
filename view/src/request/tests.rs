//! Requests that are answered, and those of other hosts, other sites and without the token.

use std::{
    net::{Ipv4Addr, Ipv6Addr},
    slice::from_ref,
};

use hyper::{
    Request,
    header::{COOKIE, HeaderName},
};

use super::*;

const LOOPBACK: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);
const OPEN: Document = Document::Metrics(Format::OpenMetrics);
const NAME: &str = "sinew_view_9464";

fn token() -> Token {
    Token::of([7; 16])
}

fn asked_at(
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
    let access = Access { listens, token: &token(), cookie: NAME };
    document(Head { method, uri, headers, has_body: false }, access)
}

fn asked(method: Method, uri: &str, headers: &[(HeaderName, &str)]) -> Result<Document, RequestError> {
    asked_at(method, uri, headers, LOOPBACK)
}

fn from_host(host: &str, listens: IpAddr) -> Result<Document, RequestError> {
    asked_at(Method::GET, "/metrics", &[(HOST, host)], listens)
}

/// Asks with the token and these headers.
fn page(method: Method, uri: &str, headers: &[(HeaderName, &str)]) -> Result<Document, RequestError> {
    let cookie = format!("{NAME}={}", token().text());
    let own = [(HOST, "localhost:9464"), (COOKIE, cookie.as_str())];
    asked(method, uri, &[&own[..], headers].concat())
}

#[test]
fn only_requests_for_this_host_are_answered() {
    for host in ["localhost", "LOCALHOST:9464", "127.0.0.1:9464", "127.0.0.9", "[::1]:9464", "[::1]"] {
        assert_eq!(from_host(host, LOOPBACK), Ok(OPEN), "{host}");
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
    assert_eq!(from_host("10.0.0.1:9464", listens), Ok(OPEN));
    assert_eq!(from_host("10.0.0.2:9464", listens), Err(RequestError::OtherHost));
    for listens in [IpAddr::V4(Ipv4Addr::UNSPECIFIED), IpAddr::V6(Ipv6Addr::UNSPECIFIED)] {
        assert_eq!(from_host("10.0.0.2:9464", listens), Ok(OPEN));
        assert_eq!(from_host("robot.example:9464", listens), Err(RequestError::OtherHost));
    }
}

#[test]
fn host_is_required_once_also_for_full_address() {
    assert_eq!(asked(Method::GET, "/", &[]), Err(RequestError::NoHost));
    let two = [(HOST, "localhost"), (HOST, "evil.example")];
    assert_eq!(asked(Method::GET, "/metrics", &two), Err(RequestError::NoHost));
    let full = asked(Method::GET, "http://evil.example/metrics", &[(HOST, "localhost")]);
    assert_eq!(full, Err(RequestError::OtherHost));
}

#[test]
fn each_page_has_its_path_and_others_are_refused() {
    assert_eq!(asked(Method::GET, "/metrics?x=1", &[(HOST, "localhost")]), Ok(OPEN));
    let file = |path| Ok(Document::File(assets::find(path).expect("it is part of the page")));
    assert_eq!(page(Method::GET, "/", &[]), file("/"));
    assert_eq!(page(Method::GET, "/main.js", &[]), file("/main.js"));
    assert_eq!(page(Method::GET, "/api/parameters", &[]), Ok(Document::Parameters));
    for path in ["/metrics/", "/favicon.ico", "//", "/../metrics", "/api", "/main.js/"] {
        assert_eq!(page(Method::GET, path, &[]), Err(RequestError::NoPage), "{path}");
    }
    for method in [Method::POST, Method::PUT, Method::DELETE, Method::OPTIONS, Method::HEAD] {
        for path in ["/metrics", "/", "/api/stream"] {
            assert_eq!(page(method.clone(), path, &[]), Err(RequestError::Method("GET")), "{path}");
        }
    }
    assert_eq!(page(Method::PUT, "/api/parameters", &[]), Err(RequestError::Method("GET, POST")));
    assert_eq!(page(Method::GET, "/api/stop", &[]), Err(RequestError::Method("POST")));
    let headers = HeaderMap::from_iter([(HOST, "localhost".parse().expect("a valid value"))]);
    let uri = Uri::from_static("/metrics");
    let with_body = Head { method: &Method::GET, uri: &uri, headers: &headers, has_body: true };
    let access = Access { listens: LOOPBACK, token: &token(), cookie: NAME };
    assert_eq!(document(with_body, access), Err(RequestError::Body));
}

#[test]
fn all_but_the_metrics_need_the_token() {
    let own = (HOST, "localhost");
    for path in ["/", "/main.js", "/api/stream", "/api/parameters", "/api/nothing", "/?token=", "/?token=0"] {
        assert_eq!(asked(Method::GET, path, from_ref(&own)), Err(RequestError::NoToken), "{path}");
    }
    for path in ["/api/parameters", "/api/stop"] {
        assert_eq!(asked(Method::POST, path, from_ref(&own)), Err(RequestError::NoToken), "{path}");
    }
    let right = format!("/?token={}", token().text());
    assert_eq!(asked(Method::GET, &right, from_ref(&own)), Ok(Document::Login));
    // The token is in the address of the page alone.
    let elsewhere = format!("/api/parameters?token={}", token().text());
    assert_eq!(asked(Method::GET, &elsewhere, &[own]), Err(RequestError::NoToken));
}

#[test]
fn only_the_page_itself_writes() {
    let json = (CONTENT_TYPE, "application/json");
    let post = |headers: &[(HeaderName, &str)]| page(Method::POST, "/api/parameters", headers);
    let own = (ORIGIN, "http://localhost:9464");
    assert_eq!(post(&[own.clone(), json.clone()]), Ok(Document::Set));
    let stop = |headers: &[(HeaderName, &str)]| page(Method::POST, "/api/stop", headers);
    assert_eq!(stop(&[own.clone(), json.clone()]), Ok(Document::Stop));
    assert_eq!(stop(from_ref(&json)), Err(RequestError::OtherSite));
    assert_eq!(stop(from_ref(&own)), Err(RequestError::NoJson));
    assert_eq!(
        post(&[own.clone(), json.clone(), (HeaderName::from_static(FETCH_SITE), "same-origin")]),
        Ok(Document::Set)
    );
    for origin in
        ["http://localhost", "http://localhost:1", "https://localhost:9464", "http://evil.example", "null"]
    {
        let other = post(&[(ORIGIN, origin), json.clone()]);
        assert_eq!(other, Err(RequestError::OtherSite), "{origin}");
    }
    assert_eq!(post(from_ref(&json)), Err(RequestError::OtherSite));
    assert_eq!(post(&[own.clone(), own.clone(), json.clone()]), Err(RequestError::OtherSite));
    assert_eq!(
        post(&[own.clone(), json, (HeaderName::from_static(FETCH_SITE), "same-site")]),
        Err(RequestError::OtherSite)
    );
    for other in ["text/plain", "application/x-www-form-urlencoded"] {
        assert_eq!(post(&[own.clone(), (CONTENT_TYPE, other)]), Err(RequestError::NoJson));
    }
}

#[test]
fn streams_are_for_the_page_with_legal_queries() {
    let open = |uri: &str, headers: &[(HeaderName, &str)]| page(Method::GET, uri, headers);
    assert_eq!(open("/api/stream", &[]), Ok(Document::Stream(Look::default())));
    assert!(matches!(open("/api/stream?app=hip", &[]), Ok(Document::Stream(_))));
    assert_eq!(open("/api/stream?x=1", &[]), Err(RequestError::Query));
    let other = [(ORIGIN, "http://evil.example")];
    for path in ["/api/stream", "/api/parameters"] {
        assert_eq!(open(path, &other), Err(RequestError::OtherSite), "{path}");
        for site in ["cross-site", "same-site", "none"] {
            let stated = [(HeaderName::from_static(FETCH_SITE), site)];
            assert_eq!(open(path, &stated), Err(RequestError::OtherSite), "{path} {site}");
        }
    }
}

#[test]
fn older_format_is_for_clients_that_name_it_alone() {
    let format = |accept: &str| asked(Method::GET, "/metrics", &[(HOST, "localhost"), (ACCEPT, accept)]);
    let prometheus =
        "application/openmetrics-text;version=1.0.0;q=0.5,text/plain;version=0.0.4;q=0.2,*/*;q=0.1";
    for accept in ["*/*", "application/openmetrics-text", prometheus] {
        assert_eq!(format(accept), Ok(OPEN), "{accept}");
    }
    assert_eq!(format("text/plain;version=0.0.4"), Ok(Document::Metrics(Format::PlainText)));
}
