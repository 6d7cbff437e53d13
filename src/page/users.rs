//! Users who can sign in to the page, and their roles: a file with an entry for each person. It stores only an Argon2id
//! hash of each password. Programs that read the page have a token each, of which the file stores only the SHA-256.

use std::fmt::{self, Display, Formatter};
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::{Mutex, PoisonError};

use argon2::Argon2;
use argon2::password_hash::phc::PasswordHash;
use argon2::password_hash::{PasswordHasher, PasswordVerifier};
use data_encoding::{BASE64URL_NOPAD, HEXLOWER};
use regrind_document::misleading;
use regrind_formats::{OpenToOthers, readable_by_others};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use thiserror::Error;

/// First lines of the file, which explain it to a reader.
const FIRST_LINES: &str = "\
# People who can sign in to the page of this cell. `regrind users` writes this file. The file contains a hash of each password, not the password.
# Keep the file secret: a person who has a hash can find a weak password by trying many passwords.
# A `token` lets a program read the page (`regrind users token`). The file contains its hash, not the token.
";
/// Beginning of each token, by which a person or a scanner of secrets recognises it, and number of its random bytes.
const TOKEN_PREFIX: &str = "regrind_";
const TOKEN_BYTES: usize = 32;
/// Beginning of the hash of a token in the file.
const TOKEN_PROOF: &str = "sha256:";
/// Maximum length of the name of a person, in characters.
const LONGEST_NAME: usize = 64;
/// Minimum and maximum length of a password, in bytes. A shorter one is easy to guess; a longer one is rejected.
const SHORTEST_PASSWORD: usize = 10;
const LONGEST_PASSWORD: usize = 256;
/// Maximum size of the file in bytes. A longer file cannot be a list of the users of a cell.
const MAX_BYTES: u64 = 1 << 20;

/// Role of a person at the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PageRole {
    /// Can see the page, and can give no order.
    Viewer,
    /// Can see the page, and can hold a cell, for example if its figures are wrong.
    Quality,
    /// Can give all orders, but cannot continue after an alarm that only a process engineer clears.
    Operator,
    /// Can give all orders.
    Engineer,
}

impl PageRole {
    /// All roles, in ascending order of permissions.
    pub const ALL: [Self; 4] = [Self::Viewer, Self::Quality, Self::Operator, Self::Engineer];

    /// Returns the word for the role in the file of the users and on the command line.
    pub fn name(self) -> &'static str {
        ["viewer", "quality", "operator", "engineer"][self as usize]
    }

    /// Returns true if this role can give the order named `order`, such as `hold`.
    pub(crate) fn may(self, order: &str) -> bool {
        match self {
            Self::Viewer => false,
            Self::Quality => order == "hold",
            Self::Operator | Self::Engineer => true,
        }
    }
}

impl Display for PageRole {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for PageRole {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|role| role.name() == text);
        found.ok_or_else(|| "this role does not exist; the roles are viewer, quality, operator and engineer".to_owned())
    }
}

/// Person who has signed in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Person {
    /// Name that the person signs in with. It is on record with the person's orders.
    pub name: String,
    /// Role of the person.
    pub role: PageRole,
}

impl Display for Person {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({})", self.name, self.role)
    }
}

/// Errors of the file of the users, or of a change to it.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the messages tell them")]
pub enum UsersError {
    #[error("{}: the list of users cannot be read: {source}; to create a list: regrind users add NAME --role operator", .path.display())]
    Unreadable { path: PathBuf, source: io::Error },
    #[error("{}: other users of this computer can read this list of users ({}); give access only to the owner of the file: {}", .path.display(), .open.how, .open.remedy)]
    Open { path: PathBuf, open: OpenToOthers },
    #[error("{}: this file is not a list of users: {what}", .path.display())]
    Broken { path: PathBuf, what: String },
    #[error(
        "the name of a user must have 1 to {LONGEST_NAME} characters; control characters and characters that change the direction of the text are not allowed"
    )]
    Name,
    #[error("the password has {found} bytes; choose a password of {SHORTEST_PASSWORD} to {LONGEST_PASSWORD} bytes")]
    Password { found: usize },
    #[error("the hash of the password cannot be computed: {0}")]
    Hash(String),
    #[error(
        "the name {name:?} belongs to a {of} in this list; choose another name, or first remove it: regrind users remove"
    )]
    Taken { name: String, of: &'static str },
    #[error("the operating system has no random numbers for a token: {0}")]
    NoRandom(String),
}

/// Content of the file.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    #[serde(default)]
    user: Vec<User>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    token: Vec<ProgramToken>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct User {
    name: String,
    role: PageRole,
    /// Argon2id hash of the password, as a PHC string.
    proof: String,
}

/// Token of a program, which can read the page and give no orders.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ProgramToken {
    name: String,
    /// SHA-256 of the token in hexadecimal digits, after [`TOKEN_PROOF`]. The token has 256 random bits, so that nobody
    /// finds it by trying; a slow hash as that of a password is not needed.
    proof: String,
}

/// List of the people who can sign in, and of the programs that can read the page.
#[derive(Clone, Debug, Default)]
pub struct Users {
    users: Vec<User>,
    tokens: Vec<ProgramToken>,
}

impl Users {
    /// Reads a list of users from its file.
    ///
    /// # Errors
    /// A file that cannot be read, that other users of the computer can read, or that is not a valid list.
    pub fn read(path: &Path) -> Result<Self, UsersError> {
        Self::parse_from(path, &text_of(path)?)
    }

    fn parse_from(path: &Path, text: &str) -> Result<Self, UsersError> {
        Self::parse(text).map_err(|what| UsersError::Broken { path: path.to_owned(), what })
    }

    fn parse(text: &str) -> Result<Self, String> {
        let Written { user: users, token: tokens } = toml::from_str(text).map_err(|error| error.to_string())?;
        for (at, user) in users.iter().enumerate() {
            let wrong = |what: &str| Err(format!("user {} ({:?}): {what}", at + 1, user.name));
            if named(&user.name).is_err() {
                return wrong("the name is not allowed");
            }
            if users[..at].iter().any(|other| other.name == user.name) {
                return wrong("another user in the list has the same name; remove one of the two users from the file");
            }
            if PasswordHash::new(&user.proof).is_err() {
                return wrong(
                    "the `proof` of this user is not a password hash; remove this user from the file, then add the user again: regrind users add",
                );
            }
        }
        for (at, token) in tokens.iter().enumerate() {
            let wrong = |what: &str| Err(format!("token {} ({:?}): {what}", at + 1, token.name));
            if named(&token.name).is_err() {
                return wrong("the name is not allowed");
            }
            if tokens[..at].iter().any(|other| other.name == token.name)
                || users.iter().any(|user| user.name == token.name)
            {
                return wrong("another entry of the list has the same name; remove one of the two from the file");
            }
            let digits =
                token.proof.strip_prefix(TOKEN_PROOF).and_then(|digits| HEXLOWER.decode(digits.as_bytes()).ok());
            if digits.is_none_or(|bytes| bytes.len() != Sha256::output_size()) {
                return wrong(
                    "the `proof` of this token is not a hash of a token; remove this token from the file, then make a new one: regrind users token",
                );
            }
        }
        Ok(Self { users, tokens })
    }

    /// Returns the text of the file of users: TOML with a table `user` for each user, which holds name, role and hash
    /// of the password, and a table `token` for each program. [`Users::read`] reads this text.
    pub fn to_text(&self) -> String {
        let written = Written { user: self.users.clone(), token: self.tokens.clone() };
        // The list contains only strings, so the conversion to TOML cannot fail.
        format!("{FIRST_LINES}\n{}", toml::to_string(&written).unwrap_or_default())
    }

    /// Adds a person with a role and a password, or replaces the role and the password of an existing person.
    ///
    /// # Errors
    /// A name that is not allowed, or that a program has; a password that is too short or too long.
    pub fn add(&mut self, name: &str, role: PageRole, password: &str) -> Result<(), UsersError> {
        let name = named(name)?;
        if self.tokens.iter().any(|token| token.name == name) {
            return Err(UsersError::Taken { name, of: "program" });
        }
        if !(SHORTEST_PASSWORD..=LONGEST_PASSWORD).contains(&password.len()) {
            return Err(UsersError::Password { found: password.len() });
        }
        let proof = Argon2::default().hash_password(password.as_bytes());
        let proof = proof.map_err(|error| UsersError::Hash(error.to_string()))?.to_string();
        self.users.retain(|user| user.name != name);
        self.users.push(User { name, role, proof });
        self.users.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(())
    }

    /// Makes a token for the program `name`, which replaces an earlier token of this name. Returns the token. The list has
    /// only its hash, so nobody can read the token there later.
    ///
    /// # Errors
    /// A name that is not allowed, or that a person has; no random numbers.
    pub fn add_token(&mut self, name: &str) -> Result<String, UsersError> {
        let name = named(name)?;
        if self.users.iter().any(|user| user.name == name) {
            return Err(UsersError::Taken { name, of: "person" });
        }
        let mut bytes = [0; TOKEN_BYTES];
        getrandom::fill(&mut bytes).map_err(|error| UsersError::NoRandom(error.to_string()))?;
        let token = format!("{TOKEN_PREFIX}{}", BASE64URL_NOPAD.encode(&bytes));
        self.tokens.retain(|token| token.name != name);
        self.tokens.push(ProgramToken { name, proof: proof_of_token(&token) });
        self.tokens.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(token)
    }

    /// Removes the person or the program with this name. Returns false if there was none.
    pub fn remove(&mut self, name: &str) -> bool {
        let before = self.users.len() + self.tokens.len();
        self.users.retain(|user| user.name != name);
        self.tokens.retain(|token| token.name != name);
        self.users.len() + self.tokens.len() < before
    }

    /// Returns the name of each program that has a token, in alphabetical order.
    pub fn programs(&self) -> impl Iterator<Item = &str> + '_ {
        self.tokens.iter().map(|token| token.name.as_str())
    }

    /// Returns the name and the role of each person on the list, in the order of the list. [`Self::add`] sorts the list
    /// by name.
    pub fn people(&self) -> impl Iterator<Item = Person> + '_ {
        self.users.iter().map(|User { name, role, .. }| Person { name: name.clone(), role: *role })
    }

    /// Returns the user with the name `name` if `password` is correct. Returns `None` if the name or the password is
    /// wrong. For an unknown name, the function also checks a password hash, so that it takes about the same time (some
    /// hundredths of a second). An attacker therefore cannot measure which names exist.
    fn signs_in(&self, name: &str, password: &str) -> Option<AuthenticatedUser> {
        let user = self.users.iter().find(|user| user.name == name);
        let proof = user.or(self.users.first()).and_then(|user| PasswordHash::new(&user.proof).ok())?;
        let is_proven = Argon2::default().verify_password(password.as_bytes(), &proof).is_ok();
        user.filter(|_| is_proven).map(|user| AuthenticatedUser(user.clone()))
    }
}

/// Entry of the list whose person gave the correct password.
#[derive(Clone, Debug)]
pub(crate) struct AuthenticatedUser(User);

impl AuthenticatedUser {
    pub(crate) fn person(&self) -> Person {
        Person { name: self.0.name.clone(), role: self.0.role }
    }
}

/// Returns the hash of a token as it is in the file.
fn proof_of_token(token: &str) -> String {
    format!("{TOKEN_PROOF}{}", HEXLOWER.encode(&Sha256::digest(token)))
}

fn named(name: &str) -> Result<String, UsersError> {
    let name = name.trim();
    let fits = (1..=LONGEST_NAME).contains(&name.chars().count());
    if fits && misleading(name).is_none() { Ok(name.to_owned()) } else { Err(UsersError::Name) }
}

/// Reads the file of a list of users, if it is a file of at most [`MAX_BYTES`] that other users of the computer cannot
/// read.
fn text_of(path: &Path) -> Result<String, UsersError> {
    let failed = |source| UsersError::Unreadable { path: path.to_owned(), source };
    let found = std::fs::metadata(path).map_err(failed)?;
    if !found.is_file() || found.len() > MAX_BYTES {
        let what = "the path is not a file, or the file is larger than 1 MiB".into();
        return Err(UsersError::Broken { path: path.to_owned(), what });
    }
    if let Some(open) = readable_by_others(path).map_err(failed)? {
        return Err(UsersError::Open { path: path.to_owned(), open });
    }
    std::fs::read_to_string(path).map_err(failed)
}

/// List of users that is read again when its file changes. A person who is removed, or who gets another role or
/// password, is signed out at once.
pub struct UsersFile {
    path: PathBuf,
    /// Text of the file, and its users. The whole text is compared, not the time of the file: the clock of a file system
    /// may give two changes one time.
    read: Mutex<(String, Users)>,
}

impl UsersFile {
    /// Opens the file of a list of users.
    ///
    /// # Errors
    /// The same as for [`Users::read`].
    pub fn open(path: &Path) -> Result<Self, UsersError> {
        let text = text_of(path)?;
        let users = Users::parse_from(path, &text)?;
        Ok(Self { path: path.to_owned(), read: Mutex::new((text, users)) })
    }

    /// Returns the list of users as the file has it now. The list is empty if the file cannot be read.
    fn now(&self) -> Users {
        let Ok(text) = text_of(&self.path) else { return Users::default() };
        let mut read = self.read.lock().unwrap_or_else(PoisonError::into_inner);
        if read.0 != text {
            let users = Users::parse(&text).unwrap_or_default();
            *read = (text, users);
        }
        read.1.clone()
    }

    /// Returns the names and roles of the users, in the order of the file.
    pub(crate) fn names(&self) -> Vec<(String, PageRole)> {
        self.now().users.into_iter().map(|user| (user.name, user.role)).collect()
    }

    /// Returns the user with this name and password; `None` if one of them is wrong. Blocks for some hundredths of a
    /// second.
    pub(crate) fn signs_in(&self, name: &str, password: &str) -> Option<AuthenticatedUser> {
        self.now().signs_in(name, password)
    }

    /// Returns the entry of the token `token`; `None` if the list has no such token.
    pub(crate) fn program(&self, token: &str) -> Option<ProgramToken> {
        let proof = proof_of_token(token);
        self.now().tokens.into_iter().find(|known| known.proof == proof)
    }

    /// Returns true if the current list contains this token with the same name.
    pub(crate) fn has_program(&self, token: &ProgramToken) -> bool {
        self.now().tokens.contains(token)
    }

    /// Returns true if the current list of users contains this user with the same name, role and password hash as at
    /// the sign-in.
    pub(crate) fn has(&self, AuthenticatedUser(was): &AuthenticatedUser) -> bool {
        self.now().users.contains(was)
    }
}
