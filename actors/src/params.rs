//! Declares the parameters of an application.

/// Declares the parameters of an application: values that are tuned while it runs.
///
/// Each field is `name: type = default, unit "...", range least..=greatest;` with `f64` or `i64`, or `name: bool =
/// default;`. Its doc comment is the description that `sinew param list` shows. Two words may follow:
///
/// - `slope X`, for `f64`: the value moves to a new one by at most `X` of its unit per second, tick by tick.
/// - `keep`: the value survives a restart of the application by its supervisor, and with `node.state` one of the node.
///   Others begin at their defaults again.
///
/// The macro declares a struct with a [`Param`](crate::parameters::Param) for each field, which begins at its default.
/// A loop reads it by `get`, without a lock. [`AppSpec::params`](crate::AppSpec::params) connects it with its
/// application, and `sinew param set` changes it.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// params! {
///     /// How the knee assists.
///     pub struct KneeGains {
///         /// Assistance, as a share of the model's torque.
///         assistance: f64 = 0.3, unit "1", range 0.0..=1.0, slope 0.5, keep;
///         /// Greatest torque.
///         torque_max: f64 = 20.0, unit "Nm", range 0.0..=60.0;
///         /// Steps of the ramp at the start.
///         ramp_steps: i64 = 4, unit "1", range 1..=16;
///         /// Whether the joint is damped.
///         damped: bool = true, keep;
///     }
/// }
///
/// let gains = KneeGains::new();
/// assert_eq!((gains.assistance.get(), gains.ramp_steps.get(), gains.damped.get()), (0.3, 4, true));
/// ```
///
/// A default outside of its range does not compile:
///
/// ```compile_fail
/// sinew::params! {
///     struct Gains {
///         /// Assistance.
///         assistance: f64 = 1.3, unit "1", range 0.0..=1.0;
///     }
/// }
/// ```
///
/// Nor does a parameter without a description, or a slope of a whole number:
///
/// ```compile_fail
/// sinew::params! { struct Gains { assistance: f64 = 0.3, unit "1", range 0.0..=1.0; } }
/// ```
///
/// ```compile_fail
/// sinew::params! {
///     struct Gains {
///         /// Steps.
///         steps: i64 = 4, unit "1", range 1..=16, slope 2;
///     }
/// }
/// ```
#[macro_export]
macro_rules! params {
    (@field $head:tt [$($done:tt)*]
        $(#[doc = $doc:literal])+ $field:ident: bool = $default:expr; $($rest:tt)*
    ) => {
        $crate::params!(@flag $head [$($done)*] [$field [$($doc)+] $default, false] $($rest)*);
    };
    (@field $head:tt [$($done:tt)*]
        $(#[doc = $doc:literal])+ $field:ident: bool = $default:expr, keep; $($rest:tt)*
    ) => {
        $crate::params!(@flag $head [$($done)*] [$field [$($doc)+] $default, true] $($rest)*);
    };
    (@field $head:tt [$($done:tt)*] $(#[doc = $doc:literal])+ $field:ident: $type:ident = $default:expr,
        unit $unit:literal, range $range:expr; $($rest:tt)*
    ) => {
        $crate::params!(@number $head [$($done)*]
            [$field $type [$($doc)+] $default, $unit, $range, ::core::option::Option::None, false] $($rest)*);
    };
    (@field $head:tt [$($done:tt)*] $(#[doc = $doc:literal])+ $field:ident: $type:ident = $default:expr,
        unit $unit:literal, range $range:expr, keep; $($rest:tt)*
    ) => {
        $crate::params!(@number $head [$($done)*]
            [$field $type [$($doc)+] $default, $unit, $range, ::core::option::Option::None, true] $($rest)*);
    };
    (@field $head:tt [$($done:tt)*] $(#[doc = $doc:literal])+ $field:ident: f64 = $default:expr,
        unit $unit:literal, range $range:expr, slope $slope:expr; $($rest:tt)*
    ) => {
        $crate::params!(@number $head [$($done)*]
            [$field f64 [$($doc)+] $default, $unit, $range, ::core::option::Option::Some($slope), false] $($rest)*);
    };
    (@field $head:tt [$($done:tt)*] $(#[doc = $doc:literal])+ $field:ident: f64 = $default:expr,
        unit $unit:literal, range $range:expr, slope $slope:expr, keep; $($rest:tt)*
    ) => {
        $crate::params!(@number $head [$($done)*]
            [$field f64 [$($doc)+] $default, $unit, $range, ::core::option::Option::Some($slope), true] $($rest)*);
    };
    (@field [[$(#[$meta:meta])*] [$visible:vis] $name:ident]
        [$([$field:ident $type:ident [$($doc:literal)+] $default:expr, $unit:expr, $keep:expr, $domain:expr])+]
    ) => {
        $(#[$meta])*
        $visible struct $name {
            $($(#[doc = $doc])+ $visible $field: $crate::parameters::Param<$type>,)+
        }

        impl $name {
            /// Creates the parameters, at their defaults.
            #[must_use]
            $visible fn new() -> ::std::sync::Arc<Self> {
                ::std::sync::Arc::new(Self { $($field: $crate::parameters::Param::new($default)),+ })
            }
        }

        impl $crate::parameters::Parameters for $name {
            fn descriptors(&self) -> &'static [$crate::parameters::Descriptor] {
                const DESCRIPTORS: &[$crate::parameters::Descriptor] = &[$($crate::parameters::Descriptor {
                    name: ::core::stringify!($field),
                    description: ::core::concat!($($doc, "\n"),+),
                    unit: $unit,
                    domain: $domain,
                    keep: $keep,
                }),+];
                const _: () = $crate::parameters::check(DESCRIPTORS);
                DESCRIPTORS
            }

            fn cell(&self, index: usize) -> ::core::option::Option<&$crate::parameters::Cell> {
                [$(self.$field.cell()),+].get(index).copied()
            }
        }
    };
    (@field $($wrong:tt)*) => {
        ::core::compile_error!(
            "a parameter is a doc comment and `name: f64 = 0.3, unit \"Nm\", range 0.0..=1.0, slope 0.5, keep;`: `slope` for f64 only, `slope` \
             and `keep` where they are wanted, in this order; i64 likewise without `slope`; a flag is `name: bool = true, keep;`"
        );
    };
    (@flag $head:tt [$($done:tt)*] [$field:ident [$($doc:literal)+] $default:expr, $keep:expr] $($rest:tt)*) => {
        $crate::params!(@field $head [$($done)* [
            $field bool [$($doc)+] $default, "", $keep, $crate::parameters::Domain::Flag { default: $default }
        ]] $($rest)*);
    };
    (@number $head:tt [$($done:tt)*]
        [$field:ident f64 [$($doc:literal)+] $default:expr, $unit:expr, $range:expr, $slope:expr, $keep:expr] $($rest:tt)*
    ) => {
        $crate::params!(@field $head [$($done)* [
            $field f64 [$($doc)+] $default, $unit, $keep, $crate::parameters::Domain::Number {
                default: $default, min: *($range).start(), max: *($range).end(), slope_per_s: $slope,
            }
        ]] $($rest)*);
    };
    (@number $head:tt [$($done:tt)*]
        [$field:ident i64 [$($doc:literal)+] $default:expr, $unit:expr, $range:expr, $slope:expr, $keep:expr] $($rest:tt)*
    ) => {
        $crate::params!(@field $head [$($done)* [
            $field i64 [$($doc)+] $default, $unit, $keep, $crate::parameters::Domain::Integer {
                default: $default, min: *($range).start(), max: *($range).end(),
            }
        ]] $($rest)*);
    };
    (@number $($wrong:tt)*) => {
        ::core::compile_error!("a parameter is an f64, an i64 or a bool");
    };
    ($(#[$meta:meta])* $visible:vis struct $name:ident { $($fields:tt)+ }) => {
        $crate::params!(@field [[$(#[$meta])*] [$visible] $name] [] $($fields)+);
    };
}
