use super::{CorrectionMap, Identified, Pass, Plan};
use sha2::{Digest, Sha256};
impl Identified for Plan {
    fn identity(&self) -> [u8; 32] {
        Sha256::digest(format!("{self:?}")).into()
    }
}
impl Identified for CorrectionMap {
    fn identity(&self) -> [u8; 32] {
        Sha256::digest(format!("{self:?}")).into()
    }
}
impl Identified for Pass {
    fn identity(&self) -> [u8; 32] {
        Sha256::digest(format!("{self:?}")).into()
    }
}
