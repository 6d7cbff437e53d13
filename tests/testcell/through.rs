//! Wrapper of a machine that forwards every call that the test does not change.

/// Generates the listed methods of `Machine`, each forwarded to a field. The test implements the methods that are not
/// listed, and imports the types of `regrind::device` that the methods name.
#[macro_export]
macro_rules! through {
    ($field:ident: $($method:ident),+ $(,)?) => { $($crate::through!(@$method $field);)+ };
    (@name $field:ident) => {
        fn name(&self) -> &str {
            self.$field.name()
        }
    };
    (@connect $field:ident) => {
        async fn connect(&mut self) -> Result<Identity, DeviceError> {
            self.$field.connect().await
        }
    };
    (@prepare $field:ident) => {
        async fn prepare(&mut self, job: Job) -> Result<Armed, DeviceError> {
            self.$field.prepare(job).await
        }
    };
    (@start $field:ident) => {
        async fn start(&mut self, armed: Armed) -> Result<Started, DeviceError> {
            self.$field.start(armed).await
        }
    };
    (@acknowledge $field:ident) => {
        async fn acknowledge(&mut self, done: u32) -> Result<Status, DeviceError> {
            self.$field.acknowledge(done).await
        }
    };
    (@reconcile $field:ident) => {
        async fn reconcile(&mut self, intended: &Armed) -> Result<Reconciled, DeviceError> {
            self.$field.reconcile(intended).await
        }
    };
    (@$simply:ident $field:ident) => {
        async fn $simply(&mut self) -> Result<Status, DeviceError> {
            self.$field.$simply().await
        }
    };
}
