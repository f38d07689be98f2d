//! The requirements of an application: names in the system, a minimum count, and a wait limit for optional ones.
//!
//! A requirement is a line of text, with the same syntax in an `AppSpec`, over LNCL and in C. The
//! requirements of an application are met when each one in its list is met.
//!
//! | text | met when |
//! | --- | --- |
//! | `knee.drive` | an application of this name is ready |
//! | `*.drive` | one whose name matches is; `*` matches any characters, also none |
//! | `hip.imu \| knee.imu` | any of these is |
//! | `2 of *.drive` | at least 2 applications are; applications of one name on several nodes count once each |
//! | `knee.drive at homed`, `2 of *.drive at homed` | it has reached the phase `homed` in its current incarnation, ready or not |
//! | `camera ?500ms`, `2 of *.drive ?2s` | it is, or the application has waited this long: it then starts without it |

use std::{fmt, str::FromStr, time::Duration};

use serde::{Deserialize, Serialize};

use crate::name::{NAME_BYTES_MAX, is_invisible};

/// Maximum length of a requirement in bytes.
pub const REQUIREMENT_BYTES_MAX: usize = 255;
/// Maximum number of names or patterns in one requirement.
pub const ALTERNATIVES_MAX: usize = 16;
/// The separator after the count of a requirement.
const OF: &str = " of ";
/// The separator before the phase of a requirement.
const AT: &str = " at ";

/// One requirement of an application: its text and its parsed form.
///
/// # Examples
///
/// ```
/// use sinew::{app::Requirement, prelude::*};
/// # struct Gait;
/// # impl Actor for Gait { type Context = AppContext<Self>; }
///
/// let spec = AppSpec::new("gait", || Gait).requires(["knee.drive", "hip.imu | knee.imu", "2 of *.drive", "camera ?2s"]);
/// let same = AppSpec::new("gait", || Gait).requires([
///     Requirement::name("knee.drive"),
///     Requirement::any(["hip.imu", "knee.imu"]),
///     Requirement::at_least(2, ["*.drive"]),
///     Requirement::name("camera").or_after(Duration::from_secs(2)),
/// ]);
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Requirement {
    text: String,
    at_least: usize,
    of: Vec<String>,
    phase: Option<String>,
    or_after: Option<Duration>,
}

/// An invalid requirement text. This is an error of the caller.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the requirement {text:?} cannot be used: {why}")]
pub struct RequirementError {
    /// The text, or its beginning.
    pub text: String,
    /// The cause and the correct syntax.
    pub why: &'static str,
}

impl Requirement {
    /// Requires an application that is ready and has this name, or a name that matches this pattern.
    #[must_use]
    pub fn name(name: impl Into<String>) -> Self {
        Self::at_least(1, [name])
    }

    /// Requires an application that is ready and has any of these names or patterns.
    #[must_use]
    pub fn any<N: Into<String>>(names: impl IntoIterator<Item = N>) -> Self {
        Self::at_least(1, names)
    }

    /// Requires at least `count` ready applications with names that are in this list or match it. Each
    /// application counts once. Applications of one name on several nodes count once each. The application
    /// that declares the requirement counts too: it does not wait for itself.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{app::Requirement, prelude::*};
    ///
    /// struct Gait;
    /// # impl Actor for Gait { type Context = AppContext<Self>; }
    ///
    /// let drives = Requirement::at_least(2, ["*.drive"]);
    /// assert_eq!(drives.as_str(), "2 of *.drive");
    /// let gait = AppSpec::new("gait", || Gait).requires([drives]);
    /// ```
    #[must_use]
    pub fn at_least<N: Into<String>>(count: usize, names: impl IntoIterator<Item = N>) -> Self {
        let of: Vec<String> = names.into_iter().map(|name| plain(&name.into())).collect();
        Self { text: String::new(), at_least: count, of, phase: None, or_after: None }.spelled()
    }

    /// Requires that the applications have reached this phase in their current incarnations. They need not be
    /// ready. A phase is one word ([`is_phase`]).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::app::Requirement;
    ///
    /// let homed = Requirement::at_least(2, ["*.drive"]).at("homed");
    /// assert_eq!(homed.as_str(), "2 of *.drive at homed");
    /// ```
    #[must_use]
    pub fn at(mut self, phase: impl Into<String>) -> Self {
        self.phase = Some(phase.into());
        self.spelled()
    }

    /// Makes the requirement optional after this wait at the barrier: the application then starts without it
    /// and receives [`RequirementEvent::Without`](crate::app::RequirementEvent::Without). The wait is a whole
    /// number of milliseconds.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{app::Requirement, prelude::*};
    ///
    /// let camera = Requirement::name("camera").or_after(Duration::from_secs(2));
    /// assert_eq!(camera.wait_max(), Some(Duration::from_secs(2)));
    /// assert_eq!("camera ?2s".parse::<Requirement>().map(|same| same.wait_max()), Ok(camera.wait_max()));
    /// ```
    #[must_use]
    pub fn or_after(mut self, wait: Duration) -> Self {
        self.or_after = Some(wait);
        self.spelled()
    }

    /// Sets the text from the parsed form.
    fn spelled(mut self) -> Self {
        self.text = self.of.join(" | ");
        if self.at_least != 1 {
            self.text = format!("{}{OF}{}", self.at_least, self.text);
        }
        if let Some(phase) = &self.phase {
            self.text = format!("{}{AT}{phase}", self.text);
        }
        if let Some(wait) = self.or_after {
            self.text = format!("{} ?{}ms", self.text, wait.as_millis());
        }
        self
    }

    /// Returns the text of the requirement.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.text
    }

    /// Returns how many applications are required.
    #[must_use]
    pub const fn count(&self) -> usize {
        self.at_least
    }

    /// Returns the names and patterns that count for the requirement.
    #[must_use]
    pub fn alternatives(&self) -> &[String] {
        &self.of
    }

    /// Returns the phase that the applications must have reached. `None`: they must be ready.
    #[must_use]
    pub fn phase(&self) -> Option<&str> {
        self.phase.as_deref()
    }

    /// Returns the maximum wait for the requirement. `None`: the application does not start without it.
    #[must_use]
    pub const fn wait_max(&self) -> Option<Duration> {
        self.or_after
    }

    /// Returns the name if the requirement is one plain name and nothing else.
    #[must_use]
    pub fn only_name(&self) -> Option<&str> {
        self.one_name().filter(|_| self.phase.is_none() && self.or_after.is_none())
    }

    /// Returns the name if the requirement is one name, with any phase and any wait.
    #[must_use]
    pub fn one_name(&self) -> Option<&str> {
        match self.of.as_slice() {
            [name] if self.at_least == 1 && !is_pattern(name) => Some(name),
            _ => None,
        }
    }

    /// Returns whether an application of this name counts for the requirement.
    #[must_use]
    pub fn counts(&self, name: &str) -> bool {
        self.of.iter().any(|pattern| matches(pattern, name))
    }
}

/// Returns whether the text is a valid phase: one word of 1 to 63 bytes, without `*`, `|` and `?`.
#[must_use]
pub fn is_phase(text: &str) -> bool {
    let is_odd = |letter: char| letter.is_whitespace() || letter.is_control() || "*|?".contains(letter);
    (1..=NAME_BYTES_MAX).contains(&text.len()) && !text.contains(is_odd)
}

/// Returns whether the text is a pattern, which may match more than one name.
#[must_use]
pub fn is_pattern(text: &str) -> bool {
    text.contains('*')
}

/// Returns whether `name` matches `pattern`, in which `*` matches any characters, also none.
#[must_use]
pub fn matches(pattern: &str, name: &str) -> bool {
    let mut parts = pattern.split('*');
    let first = parts.next().unwrap_or_default();
    let Some(mut rest) = name.strip_prefix(first) else { return false };
    let Some(last) = parts.next_back() else { return rest.is_empty() };
    // The earliest match of each part leaves the most text to the parts after it.
    for part in parts {
        let Some(at) = rest.find(part) else { return false };
        rest = &rest[at + part.len()..];
    }
    rest.ends_with(last)
}

impl FromStr for Requirement {
    type Err = RequirementError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        parse(text).map_err(|why| RequirementError { text: text.chars().take(NAME_BYTES_MAX).collect(), why })
    }
}

fn parse(text: &str) -> Result<Requirement, &'static str> {
    if text.len() > REQUIREMENT_BYTES_MAX {
        return Err("it has more than 255 bytes; require less, or use patterns");
    }
    let (choice, or_after) = match text.rsplit_once(" ?") {
        Some((choice, wait)) => {
            (choice, Some(duration(wait).ok_or("what follows ` ?` is a time: `500ms` or `2s`")?))
        }
        None => (text, None),
    };
    let (choice, phase) = match choice.rsplit_once(AT) {
        Some((choice, phase)) if is_phase(phase) => (choice, Some(phase.to_owned())),
        Some(_) | None => (choice, None),
    };
    let counted = choice.split_once(OF).and_then(|(count, of)| Some((count.parse::<u16>().ok()?, of)));
    let (at_least, choice) = counted.unwrap_or((1, choice));
    if at_least == 0 {
        return Err("0 of something is no requirement; leave it out");
    }
    let mut of = Vec::new();
    for name in choice.split('|').map(str::trim) {
        if name.is_empty() || name.len() > NAME_BYTES_MAX {
            return Err("each name in it has 1 to 63 bytes");
        }
        if name.chars().any(is_invisible) {
            return Err("a name has no control characters and no invisible ones");
        }
        let name = plain(name);
        if !of.contains(&name) {
            of.push(name);
        }
    }
    if of.len() > ALTERNATIVES_MAX {
        return Err("it chooses between more than 16 names; use a pattern");
    }
    Ok(Requirement { text: text.to_owned(), at_least: usize::from(at_least), of, phase, or_after })
}

/// Normalizes a name or pattern: each run of `*` becomes one `*`, which matches the same names at less cost.
fn plain(name: &str) -> String {
    let mut before = None;
    name.chars().filter(|letter| before.replace(*letter) != Some('*') || *letter != '*').collect()
}

/// Parses `500ms` or `2s`.
fn duration(text: &str) -> Option<Duration> {
    let (number, unit_ms) = match text.strip_suffix("ms") {
        Some(number) => (number, 1),
        None => (text.strip_suffix('s')?, 1_000),
    };
    let number: u32 = number.parse().ok()?;
    Some(Duration::from_millis(u64::from(number) * unit_ms))
}

impl TryFrom<String> for Requirement {
    type Error = RequirementError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<Requirement> for String {
    fn from(requirement: Requirement) -> Self {
        requirement.text
    }
}

impl fmt::Display for Requirement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn read(text: &str) -> Requirement {
        text.parse().unwrap()
    }

    #[test]
    fn each_form_parses_to_its_meaning() {
        assert_eq!(read("knee.drive").only_name(), Some("knee.drive"));
        assert_eq!(read("a | b|c").alternatives(), ["a", "b", "c"]);
        let counted = read("2 of *.drive ?1500ms");
        assert_eq!((counted.count(), counted.wait_max()), (2, Some(Duration::from_millis(1_500))));
        assert_eq!(
            read("a** | a*|a|***b*").alternatives(),
            ["a*", "a", "*b*"],
            "no star twice, nothing twice"
        );
        assert_eq!(read("camera ?2s").wait_max(), Some(Duration::from_secs(2)));
        assert_eq!(read("king of spain").only_name(), Some("king of spain"), "no number, no count");
        assert_eq!((read("*.drive").only_name(), read("a ?1s").only_name()), (None, None));
        let phased = read("2 of *.drive at homed ?2s");
        assert_eq!(
            (phased.phase(), phased.count(), phased.alternatives()),
            (Some("homed"), 2, &["*.drive".to_owned()][..])
        );
        assert_eq!((phased.wait_max(), phased.only_name()), (Some(Duration::from_secs(2)), None));
        assert_eq!(read("a at homed").one_name(), Some("a"));
        assert_eq!(read("king at the castle").only_name(), Some("king at the castle"), "no word, no phase");
    }

    #[test]
    fn built_requirement_equals_its_text_form() {
        let built = [
            Requirement::name("knee"),
            Requirement::any(["a", "b*"]),
            Requirement::at_least(3, ["*.drive"]).or_after(Duration::from_millis(20)),
            Requirement::any(["a", "b"]).or_after(Duration::from_millis(20)).at("homed"),
        ];
        for requirement in built {
            assert_eq!(read(requirement.as_str()), requirement);
        }
    }

    #[test]
    fn invalid_requirement_is_rejected_with_reason() {
        let long = "x".repeat(64);
        let many = vec!["a"; 300].join("|");
        for bad in ["", "a |", "0 of a", "a ?soon", "a ?", "a\nb", long.as_str(), many.as_str()] {
            assert!(bad.parse::<Requirement>().is_err(), "{bad:?}");
        }
        let names: Vec<String> = (0..=ALTERNATIVES_MAX).map(|index| index.to_string()).collect();
        assert!(names.join("|").parse::<Requirement>().is_err());
        assert_eq!(
            "0 of a".parse::<Requirement>().unwrap_err().to_string(),
            "the requirement \"0 of a\" cannot be used: 0 of something is no requirement; leave it out"
        );
    }

    #[test]
    fn star_matches_any_characters() {
        for (pattern, name, expected) in [
            ("*.drive", "knee.drive", true),
            ("*.drive", "drive", false),
            ("*.drive", "knee.drive.left", false),
            ("leg*", "leg", true),
            ("a*b*c", "aXbYbZc", true),
            ("a*b*c", "acb", false),
            ("ab*ba", "aba", false),
            ("*", "", true),
            ("plain", "plainer", false),
        ] {
            assert_eq!(matches(pattern, name), expected, "{pattern} {name}");
        }
    }

    /// The plain definition: a star is nothing, or one character and a star.
    fn by_definition(pattern: &[u8], name: &[u8]) -> bool {
        match (pattern.split_first(), name.split_first()) {
            (None, None) => true,
            (Some((b'*', rest)), None) => by_definition(rest, name),
            (Some((b'*', rest)), Some((_, less))) => {
                by_definition(rest, name) || by_definition(pattern, less)
            }
            (Some((a, rest)), Some((b, less))) => a == b && by_definition(rest, less),
            (None, Some(_)) | (Some(_), None) => false,
        }
    }

    proptest! {
        #[test]
        fn matching_agrees_with_the_definition(pattern in "[ab*]{0,7}", name in "[ab]{0,8}") {
            prop_assert_eq!(matches(&pattern, &name), by_definition(pattern.as_bytes(), name.as_bytes()));
        }

        #[test]
        fn any_text_is_a_requirement_or_rejected(text in ".{0,40}") {
            if let Ok(requirement) = text.parse::<Requirement>() {
                prop_assert_eq!(requirement.as_str(), text.as_str());
                prop_assert!(requirement.count() > 0 && !requirement.alternatives().is_empty());
            }
        }
    }
}
