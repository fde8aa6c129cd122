//! Codes with their texts.

/// Defines a constant for each code, and the function that returns the text of a code.
macro_rules! codes {
    (
        $(#[$doc:meta])* $function:ident($int:ty), else { $($other:pat => $default:expr,)* };
        $($name:ident = $code:literal, $text:literal;)*
    ) => {
        $(#[doc = concat!("`", stringify!($code), "`: ", $text, ".")] pub const $name: $int = $code;)*

        $(#[$doc])*
        #[must_use]
        pub const fn $function(code: $int) -> &'static str {
            match code {
                $($name => $text,)*
                $($other => $default,)*
            }
        }
    };
}
pub(crate) use codes;
