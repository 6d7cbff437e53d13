//! Devices file of an agent: the data items of a cell, in the XML of MTConnect 2.0.

use std::fmt::Write;
use std::time::SystemTime;

use jiff::Timestamp;

use super::items::{ALARMS, ITEMS, Item, Place};
use crate::settings::MtConnectSettings;

/// Returns the text of the devices file for the cell named `cell`, with the settings `settings`.
pub fn devices_file(settings: &MtConnectSettings, cell: &str) -> String {
    let device = identifier(cell);
    let uuid = settings.uuid.clone().unwrap_or_else(|| format!("regrind-{device}"));
    let time = Timestamp::try_from(SystemTime::now()).unwrap_or_default().strftime("%Y-%m-%dT%H:%M:%SZ").to_string();
    let version = env!("CARGO_PKG_VERSION");
    let of = |place, indent| items(&device, place, indent);
    format!(
        r#"<?xml version="1.0" encoding="UTF-8"?>
<MTConnectDevices xmlns="urn:mtconnect.org:MTConnectDevices:2.0" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:schemaLocation="urn:mtconnect.org:MTConnectDevices:2.0 http://schemas.mtconnect.org/schemas/MTConnectDevices_2.0.xsd">
  <Header creationTime="{time}" sender="regrind" instanceId="0" version="2.0.0.0" bufferSize="131072" assetBufferSize="1024" assetCount="0" deviceModelChangeTime="{time}"/>
  <Devices>
    <Device id="{device}" name="{device}" uuid="{uuid}">
      <Description manufacturer="The Regrind developers" model="Regrind {version}">{cell}: a grinder and a coordinate measuring machine</Description>
      <DataItems>
{}      </DataItems>
      <Components>
        <Controller id="{device}_controller" name="controller">
          <DataItems>
            <DataItem category="CONDITION" id="{device}_{ALARMS}" name="{ALARMS}" type="SYSTEM"/>
{}          </DataItems>
          <Components>
            <Path id="{device}_path" name="path">
              <DataItems>
{}              </DataItems>
            </Path>
          </Components>
        </Controller>
      </Components>
    </Device>
  </Devices>
</MTConnectDevices>
"#,
        of(Place::Device, 8),
        of(Place::Controller, 12),
        of(Place::Path, 16),
        uuid = escaped(&uuid),
        cell = escaped(cell),
    )
}

/// Returns the elements of the data items of a component, one on each line.
fn items(device: &str, place: Place, indent: usize) -> String {
    let mut text = String::new();
    for item in ITEMS.iter().filter(|item| item.place == place) {
        let Item { name, kind, sub_type, units, .. } = item;
        let category = item.category();
        let sub_type = sub_type.map_or(String::new(), |sub_type| format!(" subType=\"{sub_type}\""));
        let units = units.map_or(String::new(), |units| format!(" units=\"{units}\" nativeUnits=\"{units}\""));
        // Writing into a string does not fail.
        let _ = writeln!(
            text,
            "{:indent$}<DataItem category=\"{category}\" id=\"{device}_{name}\" name=\"{name}\" type=\"{kind}\"{sub_type}{units}/>",
            ""
        );
    }
    text
}

/// Returns a name as an identifier of XML.
fn identifier(name: &str) -> String {
    let valid = |c: char| if c.is_ascii_alphanumeric() || c == '-' || c == '_' || c == '.' { c } else { '_' };
    let name: String = name.chars().map(valid).collect();
    if name.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_') { name } else { format!("_{name}") }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn devices_file_has_each_item_once() {
        let settings = MtConnectSettings { listen: "127.0.0.1:0".parse().unwrap(), uuid: None };
        let text = devices_file(&settings, "1 <cell> & \"more\"");
        let ids: Vec<_> = text.split(" id=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
        assert_eq!(ids.iter().collect::<BTreeSet<_>>().len(), ids.len(), "{ids:?}");
        assert!(ids.iter().all(|id| id.starts_with("_1__cell_____more_")), "{ids:?}");
        // The device, its two components, the alarms and the items.
        assert_eq!(ids.len(), 4 + ITEMS.len());
        assert!(!text.contains("<cell>") && text.contains("1 &lt;cell&gt; &amp; &quot;more&quot;: a grinder"));
    }
}
