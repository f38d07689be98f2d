//! Checks the request with which a client opens a connection. Browsers let every website open a connection to this
//! host, so the address has a token.

use std::net::IpAddr;

use base64::prelude::{BASE64_STANDARD, Engine as _};
use hyper::{
    HeaderMap, Method,
    header::{
        CONNECTION, HeaderName, SEC_WEBSOCKET_KEY, SEC_WEBSOCKET_PROTOCOL, SEC_WEBSOCKET_VERSION, UPGRADE,
    },
};
use ring::digest::{SHA1_FOR_LEGACY_USE_ONLY, digest};

use super::protocol::PROTOCOLS;
use crate::{
    auth::Token,
    request::{Head, RequestError, check_host},
};

/// Joined to the key of a client: RFC 6455, section 1.3.
const KEY_SUFFIX: &str = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11";
/// Bytes of the key of a client.
const KEY_BYTES: usize = 16;

/// The answer to a request that is accepted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Accepted {
    /// The protocol.
    pub(super) protocol: &'static str,
    /// The proof that the request was read as one for a WebSocket.
    pub(super) proof: String,
}

/// Checks a request. The server listens on `listens`.
///
/// # Errors
/// Why it is refused.
pub(super) fn check(head: Head<'_>, listens: IpAddr, token: &Token) -> Result<Accepted, RequestError> {
    check_host(head, listens)?;
    if *head.method != Method::GET {
        return Err(RequestError::Method("GET"));
    }
    if head.has_body {
        return Err(RequestError::Body);
    }
    let mut pairs = head.uri.query().unwrap_or_default().split('&').filter_map(|pair| pair.split_once('='));
    if !pairs.any(|(key, value)| key == "token" && token.is(value)) {
        return Err(RequestError::NoFoxgloveToken);
    }
    let has = |name, word: &str| words(head.headers, name).any(|found| found.eq_ignore_ascii_case(word));
    let key = head.headers.get(SEC_WEBSOCKET_KEY).and_then(|key| key.to_str().ok());
    let key = key.filter(|key| BASE64_STANDARD.decode(key).is_ok_and(|bytes| bytes.len() == KEY_BYTES));
    let is_upgrade =
        has(UPGRADE, "websocket") && has(CONNECTION, "upgrade") && has(SEC_WEBSOCKET_VERSION, "13");
    let (true, Some(key)) = (is_upgrade, key) else { return Err(RequestError::NoWebSocket) };
    let known = |offered: &str| PROTOCOLS.into_iter().find(|protocol| *protocol == offered);
    let protocol = words(head.headers, SEC_WEBSOCKET_PROTOCOL).find_map(known);
    let protocol = protocol.ok_or(RequestError::NoProtocol)?;
    Ok(Accepted { protocol, proof: proof(key) })
}

/// Returns the words of a header with commas between them.
fn words(headers: &HeaderMap, name: HeaderName) -> impl Iterator<Item = &str> {
    let texts = headers.get_all(name).into_iter().filter_map(|value| value.to_str().ok());
    texts.flat_map(|text| text.split(',')).map(str::trim)
}

/// Returns the proof for a key. RFC 6455 asks for this digest; no secret depends on it.
fn proof(key: &str) -> String {
    BASE64_STANDARD.encode(digest(&SHA1_FOR_LEGACY_USE_ONLY, format!("{key}{KEY_SUFFIX}").as_bytes()))
}

#[cfg(test)]
mod tests {
    use hyper::Uri;

    use super::*;

    const TOKEN: [u8; 16] = [0xa5; 16];

    /// Headers of a client, as names and values.
    const HEADERS: [(&str, &str); 6] = [
        ("host", "127.0.0.1:8765"),
        ("upgrade", "websocket"),
        ("connection", "keep-alive, Upgrade"),
        ("sec-websocket-version", "13"),
        ("sec-websocket-key", "dGhlIHNhbXBsZSBub25jZQ=="),
        ("sec-websocket-protocol", "foxglove.sdk.v2, foxglove.websocket.v1, foxglove.sdk.v1"),
    ];

    fn answer(query: &str, change: (&'static str, &str)) -> Result<Accepted, RequestError> {
        let mut headers = HeaderMap::new();
        for (name, value) in HEADERS.into_iter().chain([change]) {
            headers.insert(name, value.parse().expect("a header"));
        }
        let uri: Uri = format!("/?{query}").parse().expect("a path");
        let head = Head { method: &Method::GET, uri: &uri, headers: &headers, has_body: false };
        check(head, [127, 0, 0, 1].into(), &Token::of(TOKEN))
    }

    #[test]
    fn request_with_the_token_is_accepted_from_any_site() {
        let token = Token::of(TOKEN);
        let with_token = format!("token={}", token.text());
        // The proof is that of RFC 6455, section 1.3.
        let accepted =
            Accepted { protocol: "foxglove.websocket.v1", proof: "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=".to_owned() };
        assert_eq!(answer(&with_token, ("origin", "https://app.example")), Ok(accepted.clone()));
        assert_eq!(answer(&format!("a=b&{with_token}&c=d"), ("accept", "*/*")), Ok(accepted));
        let sdk = answer(&with_token, ("sec-websocket-protocol", "foxglove.sdk.v1"));
        assert_eq!(sdk.map(|found| found.protocol), Ok("foxglove.sdk.v1"));
    }

    #[test]
    fn other_requests_are_refused_with_a_reason() {
        let token = format!("token={}", Token::of(TOKEN).text());
        let none = ("accept", "*/*");
        for (query, change, error) in [
            ("", none, RequestError::NoFoxgloveToken),
            ("token=", none, RequestError::NoFoxgloveToken),
            (&token[..token.len() - 1], none, RequestError::NoFoxgloveToken),
            (token.as_str(), ("host", "evil.example"), RequestError::OtherHost),
            (&token, ("upgrade", "h2c"), RequestError::NoWebSocket),
            (&token, ("connection", "close"), RequestError::NoWebSocket),
            (&token, ("sec-websocket-version", "8"), RequestError::NoWebSocket),
            (&token, ("sec-websocket-key", "short"), RequestError::NoWebSocket),
            (&token, ("sec-websocket-protocol", "chat"), RequestError::NoProtocol),
        ] {
            assert_eq!(answer(query, change), Err(error), "{query} {change:?}");
        }
    }
}
