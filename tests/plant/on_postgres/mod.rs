//! Ignored unless PostgreSQL is asked for.

mod layout;
mod records;
mod rights;
mod weather;
mod work;
