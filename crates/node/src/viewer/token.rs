//! The token that allows a browser to control the program.
//!
//! A page that other machines can reach is shown to everybody, but takes commands only from browsers that have opened the
//! URL with the token, which the program prints. The token moves from the URL into a cookie, so that it is neither in the
//! address bar nor in links.

use std::{
    fs::File,
    io::{self, Read as _},
    net::SocketAddr,
};

use axum::http::{HeaderMap, HeaderValue, header};

/// Bytes of a token.
const LENGTH: usize = 16;
/// Parameter of the URL.
const PARAMETER: &str = "token=";

/// A random token. On the loopback interface there is none: whoever reaches the page may control the program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Token {
    text: String,
    /// Name of the cookie; cookies do not distinguish ports.
    cookie: String,
}

impl Token {
    /// A new token for a page at `address`, if it needs one.
    pub(super) fn for_address(address: SocketAddr) -> io::Result<Option<Self>> {
        if address.ip().is_loopback() {
            return Ok(None);
        }
        let mut bytes = [0; LENGTH];
        File::open("/dev/urandom")?.read_exact(&mut bytes)?;
        let text = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Some(Self { text, cookie: format!("eddy_token_{}", address.port()) }))
    }

    /// The query of the URL.
    pub(super) fn query(&self) -> String {
        format!("?{PARAMETER}{}", self.text)
    }

    /// Whether the token in the query of a URL is this one; `None` if the query has no token.
    pub(super) fn matches_query(&self, query: Option<&str>) -> Option<bool> {
        let mut parameters = query?.split('&');
        let given = parameters.find_map(|parameter| parameter.strip_prefix(PARAMETER))?;
        Some(self.matches(given))
    }

    /// Whether the request has the cookie.
    pub(super) fn matches_cookies(&self, headers: &HeaderMap) -> bool {
        let values = headers.get_all(header::COOKIE).iter().filter_map(|value| value.to_str().ok());
        values.flat_map(|value| value.split(';')).any(|cookie| {
            let cookie = cookie.trim().split_once('=');
            cookie.is_some_and(|(name, value)| name == self.cookie && self.matches(value))
        })
    }

    /// The cookie, for the header `Set-Cookie`.
    pub(super) fn set_cookie(&self) -> HeaderValue {
        let Self { text, cookie } = self;
        HeaderValue::try_from(format!("{cookie}={text}; Path=/; HttpOnly; SameSite=Strict"))
            .expect("letters, digits and signs")
    }

    /// Compares in constant time.
    fn matches(&self, given: &str) -> bool {
        let (ours, given) = (self.text.as_bytes(), given.as_bytes());
        ours.len() == given.len()
            && ours.iter().zip(given).fold(0, |all, (a, b)| all | (a ^ b)) == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_on_the_loopback_interface_needs_no_token() {
        for local in ["127.0.0.1:80", "[::1]:80"] {
            assert_eq!(Token::for_address(local.parse().unwrap()).unwrap(), None);
        }
    }

    #[test]
    fn a_token_is_found_in_the_query_and_in_the_cookies() {
        let [token, other] =
            [1, 2].map(|_| Token::for_address("0.0.0.0:8080".parse().unwrap()).unwrap().unwrap());
        assert_ne!(token, other);
        let query = |token: &Token| token.query().trim_start_matches('?').to_owned();
        assert_eq!(token.matches_query(Some(&query(&token))), Some(true));
        assert_eq!(token.matches_query(Some(&format!("a=b&{}", query(&token)))), Some(true));
        assert_eq!(token.matches_query(Some(&query(&other))), Some(false));
        assert_eq!(token.matches_query(Some("token=")), Some(false));
        assert_eq!(token.matches_query(Some("a=b")), None);
        assert_eq!(token.matches_query(None), None);
        let cookies = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::COOKIE, text.parse().unwrap());
            token.matches_cookies(&headers)
        };
        let ours = token.set_cookie().to_str().unwrap().split(';').next().unwrap().to_owned();
        assert!(cookies(&ours) && cookies(&format!("a=b; {ours}")));
        assert!(!cookies(&ours.replace("8080", "8081")) && !cookies(&format!("{ours}0")));
        assert!(!token.matches_cookies(&HeaderMap::new()));
    }
}
