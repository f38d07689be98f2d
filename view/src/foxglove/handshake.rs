//! Checks the request with which a client opens a connection. Browsers let every website open a connection to this
//! host, so the address has a token. Programs of this host may be let in without it, but no page of a browser.

use base64::prelude::{BASE64_STANDARD, Engine as _};
use hyper::{
    HeaderMap, Method,
    header::{
        CONNECTION, HeaderName, ORIGIN, SEC_WEBSOCKET_KEY, SEC_WEBSOCKET_PROTOCOL, SEC_WEBSOCKET_VERSION,
        UPGRADE,
    },
    http::uri::Authority,
};
use ring::digest::{SHA1_FOR_LEGACY_USE_ONLY, digest};

use super::{Identity, Reads, Writes, protocol::PROTOCOLS};
use crate::request::{Head, RequestError, check_host};

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
    /// The rights of the client.
    pub(super) writes: Writes,
}

/// Checks a request, which came over loopback if `is_local`.
///
/// # Errors
/// Why it is refused.
pub(super) fn check(head: Head<'_>, own: &Identity, is_local: bool) -> Result<Accepted, RequestError> {
    let host = check_host(head, own.listens)?;
    if *head.method != Method::GET {
        return Err(RequestError::Method("GET"));
    }
    if head.has_body {
        return Err(RequestError::Body);
    }
    let pairs = head.uri.query().unwrap_or_default().split('&').filter_map(|pair| pair.split_once('='));
    let mut tokens = pairs.filter(|(key, _)| *key == "token").peekable();
    // A wrong token, as of a former start, is no missing one: its client learns of it.
    let may_lack = own.reads == Reads::OnThisHost && is_local && tokens.peek().is_none();
    let writes = if tokens.any(|(_, value)| own.token.is(value)) {
        own.writes
    } else if may_lack && !is_of_page(head.headers, &host) {
        Writes::Refused
    } else {
        return Err(RequestError::NoFoxgloveToken);
    };
    let has = |name, word: &str| words(head.headers, name).any(|found| found.eq_ignore_ascii_case(word));
    let key = head.headers.get(SEC_WEBSOCKET_KEY).and_then(|key| key.to_str().ok());
    let key = key.filter(|key| BASE64_STANDARD.decode(key).is_ok_and(|bytes| bytes.len() == KEY_BYTES));
    let is_upgrade =
        has(UPGRADE, "websocket") && has(CONNECTION, "upgrade") && has(SEC_WEBSOCKET_VERSION, "13");
    let (true, Some(key)) = (is_upgrade, key) else { return Err(RequestError::NoWebSocket) };
    let known = |offered: &str| PROTOCOLS.into_iter().find(|protocol| *protocol == offered);
    let protocol = words(head.headers, SEC_WEBSOCKET_PROTOCOL).find_map(known);
    let protocol = protocol.ok_or(RequestError::NoProtocol)?;
    Ok(Accepted { protocol, proof: proof(key), writes })
}

/// Returns whether a page of a browser may have sent a request. A browser names the page's site in `Origin`, and no
/// site has the scheme `ws`, which some libraries of programs name there.
fn is_of_page(headers: &HeaderMap, host: &Authority) -> bool {
    let own = format!("ws://{host}");
    headers.get_all(ORIGIN).iter().any(|origin| !origin.as_bytes().eq_ignore_ascii_case(own.as_bytes()))
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
    use crate::auth::Token;

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

    fn identity(reads: Reads) -> Identity {
        let token = Token::of(TOKEN);
        Identity { listens: [127, 0, 0, 1].into(), token, reads, writes: Writes::Allowed }
    }

    fn answer(query: &str, change: (&'static str, &str)) -> Result<Accepted, RequestError> {
        answer_of(&identity(Reads::WithToken), (query, true), change)
    }

    fn answer_of(
        own: &Identity,
        (query, is_local): (&str, bool),
        change: (&'static str, &str),
    ) -> Result<Accepted, RequestError> {
        let mut headers = HeaderMap::new();
        for (name, value) in HEADERS.into_iter().chain([change]) {
            headers.insert(name, value.parse().expect("a header"));
        }
        let uri: Uri = format!("/?{query}").parse().expect("a path");
        let head = Head { method: &Method::GET, uri: &uri, headers: &headers, has_body: false };
        check(head, own, is_local)
    }

    #[test]
    fn request_with_the_token_is_accepted_from_any_site() {
        let token = Token::of(TOKEN);
        let with_token = format!("token={}", token.text());
        // The proof is that of RFC 6455, section 1.3.
        let accepted = Accepted {
            protocol: "foxglove.websocket.v1",
            proof: "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=".to_owned(),
            writes: Writes::Allowed,
        };
        assert_eq!(answer(&with_token, ("origin", "https://app.example")), Ok(accepted.clone()));
        assert_eq!(answer(&format!("a=b&{with_token}&c=d"), ("accept", "*/*")), Ok(accepted));
        let sdk = answer(&with_token, ("sec-websocket-protocol", "foxglove.sdk.v1"));
        assert_eq!(sdk.map(|found| found.protocol), Ok("foxglove.sdk.v1"));
    }

    #[test]
    fn programs_of_this_host_may_read_without_the_token() {
        let own = identity(Reads::OnThisHost);
        let writes = |query: &str, is_local, change| {
            answer_of(&own, (query, is_local), change).map(|accepted| accepted.writes)
        };
        let none = ("accept", "*/*");
        assert_eq!(writes("", true, none), Ok(Writes::Refused));
        assert_eq!(writes("", true, ("origin", "ws://127.0.0.1:8765")), Ok(Writes::Refused));
        let token = format!("token={}", own.token.text());
        assert_eq!(writes(&token, false, ("origin", "https://app.example")), Ok(Writes::Allowed));
        // And: no page of a browser, no other host, and not with a wrong token
        for (query, is_local, change) in [
            ("", true, ("origin", "https://app.example")),
            ("", true, ("origin", "http://127.0.0.1:8765")),
            ("", true, ("origin", "null")),
            ("", true, ("origin", "ws://127.0.0.1:9")),
            ("", false, none),
            (&token[..token.len() - 1], true, none),
        ] {
            let refused = writes(query, is_local, change);
            assert_eq!(refused, Err(RequestError::NoFoxgloveToken), "{query} {change:?}");
        }
        assert_eq!(writes("", true, ("host", "evil.example")), Err(RequestError::OtherHost));
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
