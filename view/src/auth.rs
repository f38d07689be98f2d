//! The token of the page. It is printed in the page's address at the start, and the browser keeps it in a cookie.

use std::{fmt, fs::File, io, io::Read as _};

use hyper::{HeaderMap, header::COOKIE};
use subtle::ConstantTimeEq as _;

/// Bytes of a token: 2^128 guesses.
const BYTES: usize = 16;

/// A secret that the page's address has. Each start has another one.
#[derive(Clone)]
pub(crate) struct Token(String);

/// Without the secret.
impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token")
    }
}

impl Token {
    /// Makes a token of the system's random bytes.
    pub(crate) fn random() -> io::Result<Self> {
        let mut bytes = [0; BYTES];
        File::open("/dev/urandom")?.read_exact(&mut bytes)?;
        Ok(Self::of(bytes))
    }

    pub(crate) fn of(bytes: [u8; BYTES]) -> Self {
        Self(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    pub(crate) fn text(&self) -> &str {
        &self.0
    }

    /// Compares in a time that does not tell where the texts differ.
    pub(crate) fn is(&self, text: &str) -> bool {
        self.0.as_bytes().ct_eq(text.as_bytes()).into()
    }

    /// Returns whether a cookie of a request has this token.
    pub(crate) fn is_in(&self, headers: &HeaderMap, cookie: &str) -> bool {
        let texts = headers.get_all(COOKIE).iter().filter_map(|value| value.to_str().ok());
        let pairs = texts.flat_map(|text| text.split(';')).filter_map(|pair| pair.trim().split_once('='));
        let mut own = pairs.filter(|(name, _)| *name == cookie);
        own.any(|(_, value)| self.is(value))
    }
}

/// Returns the name of the cookie. Cookies do not know ports, so that two pages of a host need two names.
pub(crate) fn cookie_name(port: u16) -> String {
    format!("sinew_view_{port}")
}

/// Returns the header that has a browser keep the token: only for requests of the page itself, and not for scripts.
pub(crate) fn set_cookie(name: &str, token: &Token) -> String {
    format!("{name}={}; Path=/; HttpOnly; SameSite=Strict", token.text())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_whole_token_in_its_own_cookie_is_accepted() {
        let token = Token::of([0xa5; BYTES]);
        let is_in = |cookie: String| {
            let headers = HeaderMap::from_iter([(COOKIE, cookie.parse().expect("a header"))]);
            token.is_in(&headers, "sinew_view_1")
        };
        let text = token.text().to_owned();
        assert!(is_in(format!("sinew_view_1={text}")));
        assert!(is_in(format!("a=b; sinew_view_1={text} ; sinew_view_2=x")));
        for wrong in [
            String::new(),
            text.clone(),
            format!("sinew_view_2={text}"),
            format!("sinew_view_1={}", &text[1..]),
            format!("sinew_view_1={text}0"),
            format!("sinew_view_1={}", text.to_uppercase()),
        ] {
            assert!(!is_in(wrong.clone()), "{wrong}");
        }
        assert!(!token.is_in(&HeaderMap::new(), "sinew_view_1"));
    }

    #[test]
    fn tokens_differ_and_are_not_shown() {
        let [one, other] = [Token::random().expect("random bytes"), Token::random().expect("random bytes")];
        assert!(one.text().len() == 2 * BYTES && one.text() != other.text());
        assert!(!format!("{one:?}").contains(one.text()));
    }
}
