//! Names of types, topics and nodes of ROS 2.

use std::fmt;

/// Maximum bytes of a part of a name.
pub(crate) const PART_BYTES_MAX: usize = 63;
/// Maximum bytes of the name of a topic or service.
const TOPIC_BYTES_MAX: usize = 255;

/// A name that ROS 2 does not accept.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NameError(String);

impl NameError {
    fn new(name: &str, rule: &str) -> Self {
        let shown: String = name.chars().filter(|character| !character.is_control()).take(64).collect();
        Self(format!("'{shown}': {rule}"))
    }
}

impl fmt::Display for NameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for NameError {}

/// The full name of a message or service type, such as `sensor_msgs/msg/JointState`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TypeName(String);

impl TypeName {
    /// Checks a name of three parts: package, `msg` or `srv`, name.
    ///
    /// # Errors
    /// The rule that the name breaks.
    pub fn parse(text: &str) -> Result<Self, NameError> {
        let parts: Vec<_> = text.split('/').collect();
        let [package, kind, name] = parts[..] else {
            return Err(NameError::new(text, "a type has three parts, as in std_msgs/msg/Float64"));
        };
        let is_kind = matches!(kind, "msg" | "srv");
        let begins_large = name.starts_with(|first: char| first.is_ascii_uppercase());
        if is_kind && is_word(package) && is_word(name) && begins_large {
            Ok(Self(text.to_owned()))
        } else {
            Err(NameError::new(
                text,
                "a type is a package, msg or srv, and a name with a capital, of letters and digits",
            ))
        }
    }

    /// Returns the name of a type that is referred to inside of a package: `Vector3`, `std_msgs/Header` or a full name.
    pub(crate) fn referred(text: &str, package: &str) -> Result<Self, NameError> {
        match text.split('/').count() {
            1 => Self::parse(&format!("{package}/msg/{text}")),
            2 => Self::parse(&text.replace('/', "/msg/")),
            _ => Self::parse(text),
        }
    }

    /// Returns the name of a part of a service, such as `_Request`.
    pub(crate) fn with_suffix(&self, suffix: &str) -> Self {
        Self(format!("{}{suffix}", self.0))
    }

    /// Returns the package.
    #[must_use]
    pub fn package(&self) -> &str {
        self.0.split('/').next().unwrap_or_default()
    }

    /// Returns whether this names a service.
    #[must_use]
    pub fn is_service(&self) -> bool {
        self.0.split('/').nth(1) == Some("srv")
    }

    /// Returns the full name.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Returns the name in key expressions, such as `std_msgs::msg::dds_::Float64_`.
    #[must_use]
    pub fn dds(&self) -> String {
        hiroz_schema::dds_from_canonical(&self.0)
            .expect("a checked name has three parts, msg or srv in the middle")
    }
}

impl fmt::Display for TypeName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Returns whether a text is a part of a name: letters, digits and `_`, and no digit in front.
pub(crate) fn is_word(text: &str) -> bool {
    (1..=PART_BYTES_MAX).contains(&text.len())
        && !text.starts_with(|first: char| first.is_ascii_digit())
        && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}

/// Checks the full name of a topic, service, namespace or node: `/knee/angle`. A checked name has no character with a
/// meaning in key expressions.
///
/// # Errors
/// The rule that the name breaks.
pub fn check_topic(name: &str) -> Result<(), NameError> {
    let parts = name.strip_prefix('/').filter(|_| name.len() <= TOPIC_BYTES_MAX);
    if parts.is_some_and(|parts| parts.split('/').all(is_word)) {
        return Ok(());
    }
    Err(NameError::new(
        name,
        "a name is as /knee/angle: '/' before each part of letters, digits and '_', at most 255 bytes",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn full_names_have_their_dds_form() {
        let name = TypeName::parse("std_msgs/msg/Float64").expect("a name");
        assert_eq!(name.dds(), "std_msgs::msg::dds_::Float64_");
        assert_eq!((name.package(), name.is_service()), ("std_msgs", false));
        for bad in [
            "",
            "Float64",
            "std_msgs/Float64",
            "std_msgs/msg/float64",
            "std_msgs/action/A",
            "a/msg/B/C",
            "a*/msg/B",
        ] {
            assert!(TypeName::parse(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn names_with_wildcards_are_refused() {
        assert!(check_topic("/knee/angle_2").is_ok());
        for bad in [
            "", "/", "knee", "/knee/", "//knee", "/knee/*", "/knee/**", "/kn$ee", "/2knee", "/kn%ee",
            "/\u{e9}",
        ] {
            assert!(check_topic(bad).is_err(), "{bad}");
        }
        assert!(check_topic(&format!("/{}", "a/".repeat(200))).is_err());
    }
}
