//! The query of a stream: the applications of a page, and the fields that it plots.

use std::collections::BTreeSet;

/// Bytes of a query.
pub(crate) const QUERY_MAX: usize = 4_096;
/// Applications of one page.
const APPS_MAX: usize = 8;
/// Plotted fields of one page.
const SERIES_MAX: usize = 16;
/// Separates the parts of a series: sender, destination, type, field. No name has control characters.
pub(crate) const SEPARATOR: char = '\t';

/// The applications and the plotted fields of a page.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Look {
    pub(crate) apps: BTreeSet<String>,
    /// Each with sender, destination, type and field.
    pub(crate) series: Vec<String>,
}

impl Look {
    /// Reads a query: `app=NAME` and `series=SENDER%09DESTINATION%09TYPE%09FIELD`, each any number of times. `None` if
    /// it is too long or has other parts.
    pub(crate) fn of_query(query: &str) -> Option<Self> {
        let mut look = Self::default();
        if query.len() > QUERY_MAX {
            return None;
        }
        for part in query.split('&').filter(|part| !part.is_empty()) {
            let (key, value) = part.split_once('=')?;
            let value = decoded(value)?;
            match key {
                "app" => drop(look.apps.insert(value)),
                "series" if value.matches(SEPARATOR).count() == 3 => look.series.push(value),
                _ => return None,
            }
        }
        (look.apps.len() <= APPS_MAX && look.series.len() <= SERIES_MAX).then_some(look)
    }

    /// Returns the plotted fields of a channel, each with its place among the series.
    pub(crate) fn plotted(&self, channel: &str) -> Vec<(String, usize)> {
        let fields = self.series.iter().enumerate().filter_map(|(place, series)| {
            let field = series.strip_prefix(channel)?.strip_prefix(SEPARATOR)?;
            Some((field.to_owned(), place))
        });
        fields.collect()
    }
}

/// Decodes the percent signs of a part of a query; `None` if it is no text.
fn decoded(part: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(part.len());
    let mut rest = part.bytes();
    while let Some(byte) = rest.next() {
        bytes.push(match byte {
            b'%' => {
                let digit = |byte: u8| char::from(byte).to_digit(16);
                let (high, low) = (digit(rest.next()?)?, digit(rest.next()?)?);
                u8::try_from(high * 16 + low).ok()?
            }
            b'+' => b' ',
            other => other,
        });
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn query_names_applications_and_fields() {
        let look = Look::of_query("app=hip.sensor&app=a%20b+c&series=hip%09knee%09exo.angle%09joints.0");
        let look = look.expect("it is legal");
        assert_eq!(look.apps, BTreeSet::from(["hip.sensor".to_owned(), "a b c".to_owned()]));
        assert_eq!(look.plotted("hip\tknee\texo.angle"), [("joints.0".to_owned(), 0)]);
        assert!(look.plotted("hip\tknee\texo.angl").is_empty());
        assert_eq!(Look::of_query(""), Some(Look::default()));
    }

    #[test]
    fn other_and_large_queries_are_refused() {
        let many = |part: &str, count| vec![part; count].join("&");
        let apps: Vec<_> = (0..=APPS_MAX).map(|number| format!("app={number}")).collect();
        for query in [
            "app".to_owned(),
            "x=1".to_owned(),
            "app=%".to_owned(),
            "app=%zz".to_owned(),
            "app=%ff".to_owned(),
            "series=hip%09knee".to_owned(),
            apps.join("&"),
            many("series=a%09b%09c%09d", SERIES_MAX + 1),
            format!("app={}", "x".repeat(QUERY_MAX)),
        ] {
            assert_eq!(Look::of_query(&query), None, "{query}");
        }
    }

    proptest! {
        #[test]
        fn any_query_is_read_or_refused(query in ".{0,200}") {
            let _ = Look::of_query(&query);
        }
    }
}
