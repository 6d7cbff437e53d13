//! Alarms of a cell in the languages of the page. The values of an alarm stay in the wording of the cell.

use std::borrow::Cow;

use regrind_cell::{Alarm, AlarmId};

use super::texts::Language;

/// Texts of an alarm in one language.
pub(crate) struct AlarmTexts<'a> {
    /// Cause of the alarm, with its values.
    pub(crate) event: Cow<'a, str>,
    /// Consequence of the alarm.
    pub(crate) consequence: &'a str,
    /// Remedy, as steps in this order.
    pub(crate) remedy: Vec<&'a str>,
}

/// Returns the cause, the consequence and the remedy of `alarm` in `language`. The values at the end of the cause, such
/// as a name or a measured number, are not translated.
pub(crate) fn alarm_texts(alarm: &Alarm, language: Language) -> AlarmTexts<'_> {
    let Some((head, consequence, remedy)) = translated(alarm.id, language) else {
        let remedy = alarm.remedy.iter().map(String::as_str).collect();
        return AlarmTexts { event: Cow::Borrowed(&alarm.event), consequence: &alarm.consequence, remedy };
    };
    let case = case(&alarm.event, alarm.id.head());
    AlarmTexts { event: Cow::Owned(format!("{head}{case}")), consequence, remedy: remedy.to_vec() }
}

/// Returns the specific end of `what`, the cause of an alarm. A cause consists of a general text, a colon and the
/// values of this alarm. The result begins with this colon. It is "." if there are no values.
///
/// `head` is the general text that this version of the program uses. An older record can have another general text.
/// Therefore the function does not compare the two texts. It only uses the number of colons in `head` to find the end
/// of the general text in `what`.
fn case<'a>(what: &'a str, head: &str) -> &'a str {
    let colons = head.matches(": ").count();
    what.match_indices(": ").nth(colons).map_or(".", |(at, _)| &what[at..])
}

type Entry = (&'static str, &'static str, &'static [&'static str]);

/// Returns the general cause, the consequence and the remedy of an alarm in `language`. Returns `None` for English, the
/// language of the texts in the alarm itself.
fn translated(id: AlarmId, language: Language) -> Option<Entry> {
    match language {
        Language::En => None,
        Language::De => Some(german(id)),
        Language::Zh => Some(chinese(id)),
    }
}

macro_rules! catalogue {
    ($name:ident: $($id:ident { $head:literal, $consequence:literal, [$($remedy:literal),+ $(,)?] })+) => {
        fn $name(id: AlarmId) -> Entry {
            match id {
                $(AlarmId::$id => ($head, $consequence, &[$($remedy),+]),)+
            }
        }
    };
}

catalogue! { german:
    Unreachable {
        "Eine Maschine ist nicht erreichbar", "Der Lauf beginnt nicht.",
        ["Prüfen, ob die Maschine eingeschaltet ist und ihre Steuerung läuft.", "Kabel und Adresse in der Zellendatei prüfen.",
         "Den Lauf neu starten."]
    }
    WrongDevice {
        "Es antwortet ein anderes Gerät, als die Zellendatei nennt", "Es wurde nichts geschrieben; der Lauf beginnt nicht.",
        ["Die Adresse in der Zellendatei mit der Maschine vergleichen.", "Prüfen, dass kein anderes Gerät diese Adresse hat.",
         "Den Lauf neu starten."]
    }
    WordOrder {
        "Die Maschine sendet ihre Register in anderer Wortfolge, als die Zellendatei sagt",
        "Jede Zahl wäre falsch; darum wurde nichts geschrieben, und der Lauf beginnt nicht.",
        ["word_order in der Zellendatei auf die genannte Reihenfolge stellen.", "Den Lauf neu starten."]
    }
    Inches {
        "Längen sind in Zoll", "Sie werden nicht verwendet: Regrind arbeitet in Millimetern.",
        ["Messprogramm und Steuerung auf Millimeter stellen.", "RESUME misst noch einmal; sonst den Lauf neu starten."]
    }
    Owned {
        "Ein anderer Teilnehmer hat die Maschine", "Der Lauf beginnt nicht.",
        ["Das andere Programm oder Bedienfeld finden, das die Maschine hat, und sie dort freigeben.", "Den Lauf neu starten."]
    }
    NotIdle {
        "Eine Maschine ist nicht frei", "Der Lauf beginnt nicht; an der Maschine wurde nichts geändert.",
        ["An der Maschine nachsehen und dort beenden oder löschen, was sie tut.",
         "Hat sie noch den Auftrag eines unterbrochenen Laufs, jenen Lauf fortsetzen.", "Den Lauf neu starten."]
    }
    LinkLost {
        "Die Verbindung zu einer Maschine ist verloren", "Es beginnt nichts Neues. Eine Maschine in Bewegung hält von selbst an; die Zelle fragt sie, was aus ihrem Auftrag wurde, und fährt fort, sobald die Verbindung wieder da ist.",
        ["Kabel und Netzwerk prüfen, und ob die Steuerung läuft.",
         "Antwortet die Maschine mit einer Ausnahme: Registertabelle der Zellendatei mit der der Maschine vergleichen.",
         "Warten: die Zelle fährt von selbst fort.",
         "Lässt es sich nicht beheben, den Lauf beenden oder abbrechen."]
    }
    ProgramFailed {
        "Ein Teil dieses Programms ist ausgefallen, und niemand spricht mehr mit einer Maschine", "Die Maschine hört kein Lebenszeichen und hält nach ihrer eigenen Wartezeit an. Der Lauf kann mit ihr nicht fortfahren.",
        ["An der Maschine nachsehen: was dort läuft, wird an ihrem Bedienfeld beendet.", "Den Lauf abbrechen: die andere Maschine hört das, diese nicht.",
         "Den Fehler mit dem Ordner des Laufs melden.", "Einen neuen Lauf mit einer Messung des Teils beginnen, wie es ist."]
    }
    ConditionLost {
        "Eine Voraussetzung für die Arbeit fehlt", "Die Zelle wartet und fährt von selbst fort, sobald sie wieder erfüllt ist.",
        ["Druckluft oder Kühlmittel wiederherstellen, oder das genannte Signal in seinen Bereich bringen.", "Gibt die Maschine keine Zahl für ein Signal: seine Adresse in der Zellendatei oder den Sensor berichtigen.", "Warten: die Zelle fährt von selbst fort."]
    }
    StaysSuspended {
        "Die Ursache der Unterbrechung ging nicht weg", "Die Zelle fährt nicht mehr von selbst fort.",
        ["Die Ursache beseitigen.", "RESUME drücken oder den Lauf beenden."]
    }
    MachineFault {
        "Eine Maschine ist gestört", "Beide Maschinen wurden angewiesen, nach ihrem eigenen sicheren Ablauf zu enden; der Lauf ist zu Ende.",
        ["Zuerst an der Maschine nachsehen.", "Die Ursache beseitigen und die Störung an der Maschine quittieren.",
         "Das Teil prüfen; was abgeschliffen ist, bleibt ab.", "Einen neuen Lauf beginnen, der mit einer Messung anfängt."]
    }
    MachineHeldItself {
        "Eine Maschine hat ihren Auftrag ohne Anweisung angehalten", "Die Zelle ist mit ihr angehalten.",
        ["Feststellen, warum: Vorschubhalt am Bedienfeld, stumme Leitung, Schutzhaube.", "Hier RESUME drücken, nicht an der Maschine."]
    }
    MachineResumedItself {
        "Eine angehaltene Maschine wurde an ihrem Bedienfeld freigegeben", "Der Auftrag läuft weiter, und die Zelle mit ihm.",
        ["Hier anhalten und fortsetzen, damit im Protokoll steht, wer es war."]
    }
    MovesUnasked {
        "Eine Maschine bewegt sich, die stehen sollte", "Sie wird angehalten, und die Zelle ist angehalten.",
        ["An der Maschine nachsehen: wer hat sie freigegeben?", "Kommt sie nicht zum Stehen, den Not-Halt der Maschine benutzen.",
         "RESUME, wenn bekannt ist, warum sie sich bewegte."]
    }
    NotAutomatic {
        "Eine Maschine ist nicht im Automatikbetrieb", "Es wird nichts gestartet, und was sich bewegte, ist angehalten: am Bedienfeld kann jemand sie dorthin fahren, wo die andere arbeitet.",
        ["Die Maschine aus dem Weg der anderen fahren und ihren Schlüssel auf Automatik stellen.", "Hier RESUME drücken."]
    }
    ProgressStands {
        "Ein Auftrag kommt nicht voran", "Die Maschine antwortet, und ihr Auftrag läuft; dauert das an, wird sie angehalten.",
        ["An der Maschine nachsehen: wartet sie an ihrem Bedienfeld auf etwas, oder schleift sie Luft?", "Im Zweifel den Lauf anhalten."]
    }
    MachineRefused {
        "Eine Maschine hat abgelehnt, was von ihr verlangt wurde", "Die Zelle ist vor diesem Schritt angehalten.",
        ["Tun, was die Antwort der Maschine verlangt: Automatikbetrieb, Schutzhauben zu, Teil gespannt, Daten in ihren Grenzen.",
         "RESUME fragt noch einmal."]
    }
    NoAnswer {
        "Eine Maschine hat nicht rechtzeitig geantwortet", "Die Zelle ist vor diesem Schritt angehalten.",
        ["An der Maschine und an ihrem Bedienfeld nachsehen.", "RESUME fragt noch einmal."]
    }
    JobFailed {
        "Ein Auftrag einer Maschine endete, bevor er fertig war", "Sein Ergebnis wird nicht verwendet. Ein Durchgang wird nicht wiederholt: das Teil wird gemessen, wie es ist.",
        ["Maschine und Teil ansehen.", "RESUME misst das Teil, wie es ist."]
    }
    PassRecord {
        "Was die Schleifmaschine über den Durchgang sagt, kann nicht sein", "Die Zelle ist danach angehalten. Der Durchgang wird nicht wiederholt: das Teil wird gemessen, wie es ist.",
        ["Teil und Scheibe ansehen: wurde dieser Durchgang geschliffen, mit dieser Karte und dieser Scheibe?",
         "Den Wert und seine Grenze mit dem Programm der Maschine und dem Rezept vergleichen.", "RESUME misst das Teil, wie es ist; oder den Lauf beenden."]
    }
    StartUnknown {
        "Es ist nicht bekannt, ob ein Auftrag gestartet wurde", "START wird nie auf Verdacht wiederholt. Nichts bewegt sich auf Anweisung der Zelle.",
        ["An der Maschine nachsehen: steht sie still und frei vom Teil? Wurde das Teil berührt?",
         "RESUME fragt die Maschine noch einmal.", "Kann sie es nicht sagen: den Auftrag für beendet erklären, mit dem, was zu sehen war, und mit RESUME das Teil messen.",
         "Oder den Lauf beenden."]
    }
    MachineRestarted {
        "Eine Maschine wurde mitten im Lauf neu gestartet", "Sie weiß vielleicht nicht, was sie tat. Nichts bewegt sich auf Anweisung der Zelle.",
        ["Maschine und Teil ansehen.", "RESUME fragt die Maschine, was aus dem Auftrag wurde.",
         "Kann sie es nicht sagen: den Auftrag für beendet erklären, mit dem, was zu sehen war, und mit RESUME das Teil messen."]
    }
    JobVanished {
        "Eine Maschine hat den Auftrag nicht mehr, an dem sie war", "Der Auftrag wird nicht noch einmal begonnen, und nichts bewegt sich auf Anweisung der Zelle.",
        ["Die Maschine ansehen: steht sie still und frei vom Teil? Wurde das Teil berührt?", "RESUME fragt die Maschine noch einmal.",
         "Kann sie es nicht sagen: den Auftrag für beendet erklären, mit dem, was zu sehen war; dann mit RESUME das Teil messen, wie es ist.",
         "Oder den Lauf beenden."]
    }
    FailsAgain {
        "Derselbe Schritt scheitert immer wieder", "Die Zelle ist angehalten und versucht es nicht mehr von selbst.",
        ["Die letzte Antwort lesen: sie sagt, was nicht geht.", "Die Maschine, ihr Programm und ihre Leitung ansehen.",
         "RESUME versucht es noch einmal; oder den Lauf beenden."]
    }
    ProgramRestarted {
        "Das Programm wurde mitten im Lauf neu gestartet", "Die Zelle ist angehalten; die Maschinen werden gefragt, was aus ihren Aufträgen wurde, und was sich bewegt, wird angehalten.",
        ["Beide Maschinen ansehen: der Zustand sagt, was festgestellt wurde und was nicht.", "RESUME: die Zelle fährt von dort fort."]
    }
    NotClear {
        "Eine Maschine ist nicht frei vom Teil", "Die andere Maschine wird nicht gestartet.",
        ["Sie an ihrem Bedienfeld in die Parkstellung bringen.", "RESUME drücken."]
    }
    Coverage {
        "Zu wenig vom Teil wurde gemessen", "Diese Messung wird nicht verwendet.",
        ["Auf Kühlmittel, Späne oder eine Spannpratze am Teil achten und auf einen abgenutzten oder verbogenen Taster.", "RESUME misst noch einmal."]
    }
    NoPart {
        "Es wurde kein Teil gefunden, wo es sein sollte", "Diese Messung wird nicht verwendet.",
        ["Prüfen, ob das Teil eingelegt und gespannt ist und ob es das richtige ist.", "RESUME misst noch einmal; oder den Lauf beenden."]
    }
    PartMisplaced {
        "Das Teil liegt weiter von seinem erwarteten Platz, als das Rezept erlaubt",
        "Es wird keine Karte gemacht: sie würde an falscher Stelle eingeschliffen.",
        ["Prüfen, wie das Teil liegt: verdreht, auf Spänen, in einem anderen Sitz.", "Den Lauf beenden, das Teil nach Zeichnung einlegen und einen Lauf beginnen, der mit einer Messung anfängt.",
         "Lag es die ganze Zeit richtig, misst RESUME noch einmal."]
    }
    PartMoved {
        "Das Teil liegt nicht mehr dort, wo es bei den ersten Antastungen dieser Messung lag",
        "Die wiederholten Antastungen werden nicht verwendet: sie gehören zu einer anderen Lage des Teils.",
        ["Prüfen, ob das Teil gespannt ist und niemand es bewegt hat.", "Warten, bis Teil und Raum ihre Temperatur halten.",
         "RESUME misst das ganze Teil noch einmal."]
    }
    ProbeRadius {
        "Der Radius des Tasters ist nicht der im Rezept", "Diese Messung wird nicht verwendet: jede Abweichung wäre um ihn falsch.",
        ["Kugel und Referenzkugel reinigen.", "Den Taster an der Maschine einmessen oder den richtigen einsetzen.",
         "RESUME misst noch einmal; ein Rezept mit anderem Radius braucht einen neuen Lauf."]
    }
    Contacts {
        "Die Maschine gibt Berührpunkte, wo Tastermittelpunkte erwartet werden",
        "Diese Messung wird nicht verwendet: sie wäre um den Radius des Tasters falsch.",
        ["Die Radiuskorrektur des Messprogramms ausschalten.", "RESUME misst noch einmal."]
    }
    ForeignResult {
        "Das Ergebnis gehört zu einem anderen Teil, Plan oder Zyklus", "Es wird nicht verwendet.",
        ["Nachsehen, welchen Auftrag die Maschine ausgeführt hat.", "RESUME misst noch einmal."]
    }
    BrokenResult {
        "Das Ergebnis ist beschädigt", "Es wird nicht verwendet.",
        ["Lesen, was daran nicht sein kann: ein Wert oder Punkt, der nicht sein kann, kommt vom Taster oder vom Messprogramm, eine falsche Zahl von Punkten von seiner Liste der Ziele.", "Das berichtigen; RESUME misst noch einmal."]
    }
    Temperature {
        "Die Temperatur war während der Messung außerhalb ihrer Grenzen", "Diese Messung wird nicht verwendet.",
        ["Teil und Raum zur Ruhe kommen lassen.", "RESUME misst noch einmal."]
    }
    RegistrationFailed {
        "Die Messung ließ sich nicht auf die Sollfläche ausrichten", "Diese Messung wird nicht verwendet.",
        ["Prüfen, ob das Teil und die Sollfläche im Rezept zusammengehören.", "Die Punkte dieses Zyklus im Ordner des Laufs ansehen.",
         "RESUME misst noch einmal; oder den Lauf beenden."]
    }
    ComputationLate {
        "Eine Berechnung dauert länger, als sie darf", "Die Zelle ist davor angehalten.",
        ["Prüfen, ob der Rechner überlastet ist.", "RESUME rechnet noch einmal."]
    }
    WeakDirections {
        "Die Fläche sagt nicht, wo auf dem Teil eine Korrektur eingeschliffen würde",
        "Es wird keine Korrektur gemacht. Die Fehlerkarte dieses Zyklus liegt im Ordner des Laufs.",
        ["Die genannten Richtungen im Rezept festhalten (registration.lock), wenn Spannmittel oder Bezugspunkte sie gut genug halten.",
         "Oder Merkmale messen, die sie halten: Kanten, Marken, eine weitere Öffnung.", "Einen neuen Lauf beginnen, der mit einer Messung anfängt."]
    }
    CompensationFailed {
        "Es gibt keine Karte für den nächsten Durchgang", "Es wird kein weiterer Durchgang geschliffen.",
        ["Den Grund und die Werte dieses Zyklus lesen.", "RESUME rechnet noch einmal; oder den Lauf beenden."]
    }
    ParameterBeyond {
        "Ein Parameter der Maschine weicht weiter ab, als das Rezept zulässt",
        "Der nächste Durchgang beginnt nicht, bevor jemand zustimmt: er würde mit dem korrigierten Parameter geschliffen.",
        ["Auf anderem Weg messen: den Radius der Scheibe über ihr Profil oder durch Antasten einer Referenz, Zustellung und Lage des Teils mit der Messuhr.",
         "Stimmt er, RESUME: der nächste Durchgang wird damit geschliffen, die Karte ist, was übrig bleibt.",
         "Stimmt er nicht, den Lauf beenden, Rezept oder Maschine berichtigen und einen neuen Lauf beginnen; ohne den Schlüssel in compensation.parameters geht alles in die Karte."]
    }
    SignFlipped {
        "Das Teil hat auf die Karte umgekehrt geantwortet", "Ein weiterer Durchgang würde es schlechter machen; die Zelle ist angehalten.",
        ["Das Vorzeichen der Karte an der Schleifmaschine prüfen: positiv lässt Material stehen.", "Kein RESUME, bevor ein Durchgang an einem Ausschussteil das richtige Vorzeichen gezeigt hat.",
         "Den Lauf beenden."]
    }
    Mirrored {
        "Das Teil hat wie auf eine gespiegelte oder gedrehte Karte geantwortet", "Ein weiterer Durchgang würde es schlechter machen; die Zelle ist angehalten.",
        ["Die Richtung von x und y an der Schleifmaschine prüfen und wie das Teil in seiner Spannung gedreht ist.",
         "Kein RESUME, bevor ein Durchgang an einem Ausschussteil die richtige Richtung gezeigt hat.", "Den Lauf beenden."]
    }
    Doubled {
        "Das Teil hat auf die Karte geantwortet, als wäre sie zweimal angewandt worden", "Ein weiterer Durchgang würde nach der anderen Seite ausschlagen; die Zelle ist angehalten.",
        ["Prüfen, ob die Karte im Programm und auch in der Tabelle der Steuerung steht oder zur vorigen addiert wurde: sie ist absolut.",
         "Kein RESUME, bevor sie nur an einer Stelle angewandt wird.", "Den Lauf beenden."]
    }
    NoEffect {
        "Das Teil hat auf die Karte nicht geantwortet", "Ein weiterer Durchgang würde nichts ändern; die Zelle ist angehalten.",
        ["Prüfen, ob die Scheibe das Teil erreichte und ob die Schleifmaschine die Karte benutzte.", "Scheibenradius und Nullpunkt prüfen.",
         "RESUME schleift einen weiteren Durchgang; oder den Lauf beenden."]
    }
    Diverging {
        "Das Teil wird schlechter", "Nach einem zweiten schlechteren Zyklus tut der Lauf, was das Rezept sagt: anhalten oder beenden.",
        ["Die Fehlerkarten der letzten Zyklen vergleichen.", "Auf eine abgenutzte Scheibe, eine lose Spannung, eine Änderung der Temperatur achten.",
         "Im Zweifel vor dem nächsten Durchgang anhalten."]
    }
    Stalled {
        "Das Teil wird nicht mehr besser", "Der Lauf tut, was das Rezept sagt: anhalten oder beenden.",
        ["Was übrig ist, mit der Messunsicherheit und der Wiederholbarkeit der Schleifmaschine vergleichen.",
         "RESUME schleift einen weiteren Durchgang; oder den Lauf beenden."]
    }
    Undecided {
        "Die Messung beweist weder, dass das Teil gut ist, noch dass es schlecht ist", "Der Lauf tut, was das Rezept sagt: anhalten oder beenden.",
        ["Mit mehr Punkten oder weniger Rauschen messen: eine kleinere Unsicherheit entscheidet.",
         "Ein weiterer Durchgang nähme Material weg und hilft voraussichtlich nicht."]
    }
    LeftOut {
        "Es wurden Punkte ausgelassen, mit denen kein Nachbar übereinstimmt, und mit ihnen überschreitet das Teil eine Grenze",
        "Das Teil wird nicht angenommen: was angetastet wurde, zählt, bis es neu angetastet ist.",
        ["Die genannten Stellen ansehen und reinigen, und den Taster auch, ohne das Teil zu bewegen.", "RESUME tastet sie noch einmal an, und einige Stellen um sie; was sich nicht einzeln antasten lässt, wird ganz gemessen.",
         "Werden dieselben Stellen wieder genannt, sind sie am Teil: den Lauf beenden und die Qualitätsstelle entscheiden lassen."]
    }
    MaxCycles {
        "Das Rezept erlaubt keinen weiteren Durchgang", "Der Lauf endet, das Teil ist nicht in der Toleranz.",
        ["Die Werte der Zyklen ansehen.", "Fielen sie noch, im Rezept mehr Durchgänge erlauben und einen Lauf beginnen, der mit einer Messung anfängt."]
    }
    BudgetSpent {
        "Das Material, das abgenommen werden darf, ist verbraucht", "Es wird kein weiterer Durchgang geschliffen; der Lauf endet, das Teil ist nicht in der Toleranz.",
        ["Die Qualitätsstelle über das Teil entscheiden lassen: was ab ist, bleibt ab.", "Das nächste Teil mit mehr Aufmaß beginnen."]
    }
    JournalUnwritable {
        "Das Protokoll des Laufs lässt sich nicht schreiben", "Keine neue Bewegung beginnt: was nicht im Protokoll steht, wird nicht getan.",
        ["Den Ordner des Laufs prüfen: Rechte, Netzlaufwerk, Datenträger.", "RESUME drücken."]
    }
    DiskFull {
        "Der Datenträger ist voll", "Keine neue Bewegung beginnt: was nicht im Protokoll steht, wird nicht getan.",
        ["Platz auf dem Datenträger des Laufs schaffen.", "RESUME drücken."]
    }
    ControlLost {
        "Der Weg, auf dem Anweisungen die Zelle erreichen, wurde weggenommen",
        "Der Lauf geht weiter, und der Weg wird neu gemacht. Strg-C im Terminal des Laufs hält an, zweimal bricht ab.",
        ["Feststellen, wer Dateien im Ordner des Laufs löscht oder verschiebt.", "`regrind status` zeigt, ob Anweisungen wieder ankommen.",
         "Kommen keine an, den Lauf anhalten."]
    }
    HoldNotConfirmed {
        "Eine Maschine hat nicht bestätigt, dass sie hält", "Beide Maschinen werden angewiesen, nach ihrem eigenen sicheren Ablauf zu enden.",
        ["An der Maschine nachsehen.", "Bewegt sie sich noch, den Not-Halt der Maschine benutzen."]
    }
    StopNotConfirmed {
        "Halt nicht bestätigt: eine Maschine hat nicht gesagt, dass sie steht", "Sie kann sich noch bewegen.",
        ["Den Not-Halt der Maschine benutzen.", "Von der Maschine fernbleiben, bis zu sehen ist, dass sie steht.",
         "Danach feststellen, warum sie nicht antwortet."]
    }
    WaitedTooLong {
        "Niemand hat rechtzeitig geantwortet", "Der Lauf endet geordnet.",
        ["Die Ursache des Halts beseitigen und einen Lauf beginnen, der mit einer Messung anfängt."]
    }
}

catalogue! { chinese:
    Unreachable { "无法连接到设备", "运行不会开始。", ["确认设备已通电且控制器正在运行。", "检查电缆和单元文件中的地址。", "重新启动运行。"] }
    WrongDevice { "应答的设备与单元文件所指的不同", "未写入任何内容；运行不会开始。", ["将单元文件中的地址与设备核对。", "确认没有其他设备使用该地址。", "重新启动运行。"] }
    WordOrder { "设备的寄存器字序与单元文件不一致", "所有数值都会出错，因此未写入任何内容；运行不会开始。", ["将单元文件中的 word_order 改为所指出的顺序。", "重新启动运行。"] }
    Inches { "长度单位是英寸", "这些数据不予使用：Regrind 以毫米工作。", ["将测量程序和控制器设为毫米。", "按 RESUME 重新测量，或重新启动运行。"] }
    Owned { "设备被另一个客户端占用", "运行不会开始。", ["找到占用设备的其他程序或面板并释放设备。", "重新启动运行。"] }
    NotIdle { "设备不空闲", "运行不会开始；设备上未作任何更改。", ["查看设备，在其面板上结束或清除正在进行的工作。", "如果它仍持有被中断的运行的任务，请继续那个运行。", "重新启动运行。"] }
    LinkLost { "与设备的连接中断", "不会开始新的动作。运动中的设备会自行保持；连接恢复后，单元会询问其任务的结果并继续。", ["检查电缆、交换机以及控制器是否运行。", "如果设备以异常应答：将单元文件的寄存器表与设备的核对。", "等待：单元会自行继续。", "如果无法修复，请结束或中止运行。"] }
    ProgramFailed { "本程序的一部分已失效，不再与设备通信", "设备收不到心跳，会按自身的静默时限保持。运行不能与它继续。", ["查看设备：在其面板上结束正在进行的工作。", "中止运行：另一台设备会收到，这一台不会。", "连同运行文件夹报告该故障。", "开始新的运行，先按现状测量工件。"] }
    ConditionLost { "缺少工作条件", "单元等待，条件恢复后自行继续。", ["恢复气源或冷却液，或使所指的信号回到其范围内。", "如果设备对某信号不给出数值：更正单元文件中的地址或传感器。", "等待：单元会自行继续。"] }
    StaysSuspended { "暂停的原因没有消失", "单元不再自行继续。", ["消除原因。", "按 RESUME，或结束运行。"] }
    MachineFault { "设备故障", "已要求两台设备按各自的安全流程结束；运行已结束。", ["首先查看设备。", "消除原因并在设备上清除故障。", "检查工件；已磨去的无法恢复。", "开始以测量为起点的新运行。"] }
    MachineHeldItself { "设备未经命令自行保持", "单元随之保持。", ["查明原因：面板上的进给保持、通信静默、防护门。", "在此处按 RESUME，不要在设备上操作。"] }
    MachineResumedItself { "保持中的设备在其面板上被放行", "任务继续，单元随之继续。", ["请在此处保持和继续，以便记录操作者。"] }
    MovesUnasked { "应静止的设备在运动", "已命令其保持，单元保持。", ["查看设备：谁放行了它？", "如果它不停下，请使用设备自身的急停回路。", "查明原因后按 RESUME。"] }
    NotAutomatic { "设备不在自动模式", "不启动任何动作，运动中的已保持：有人可能在面板上将它移到另一台设备的工作区。", ["将设备移出另一台的路径，并将钥匙转到自动。", "在此处按 RESUME。"] }
    ProgressStands { "任务没有进展", "设备有应答且任务在进行；如果持续如此，将被保持。", ["查看设备：它是否在面板上等待，或在空磨？", "如有疑问，请保持运行。"] }
    MachineRefused { "设备拒绝了请求", "单元在该步骤之前保持。", ["按设备的应答处理：自动模式、防护门关闭、工件夹紧、数据在其限值内。", "按 RESUME 再次请求。"] }
    NoAnswer { "设备未及时应答", "单元在该步骤之前保持。", ["查看设备及其面板。", "按 RESUME 再次请求。"] }
    JobFailed { "设备的任务在完成前结束", "其结果不予使用。磨削不重复：按现状测量工件。", ["查看设备和工件。", "按 RESUME 按现状测量工件。"] }
    PassRecord { "磨床对该次磨削的报告不可能成立", "单元在其后保持。磨削不重复：按现状测量工件。", ["查看工件和砂轮：这次磨削是否用了此误差图和此砂轮？", "将该数值及其限值与设备程序和配方核对。", "按 RESUME 按现状测量工件，或结束运行。"] }
    StartUnknown { "不知道任务是否已启动", "绝不凭猜测重复 START。单元不命令任何动作。", ["查看设备：是否静止且离开工件？工件是否被触及？", "按 RESUME 再次询问设备。", "如果它无法说明：按所见声明任务已结束，再按 RESUME 测量工件。", "或结束运行。"] }
    MachineRestarted { "设备在运行中途重新启动", "它可能不知道自己做了什么。单元不命令任何动作。", ["查看设备和工件。", "按 RESUME 询问设备任务的结果。", "如果它无法说明：按所见声明任务已结束，再按 RESUME 测量工件。"] }
    JobVanished { "设备不再有它正在执行的任务", "该任务不会再次启动。单元不命令任何动作。", ["查看设备：是否静止且离开工件？工件是否被触及？", "按 RESUME 再次询问设备。", "如果它无法说明：按所见声明任务已结束，再按 RESUME 按现状测量工件。", "或结束运行。"] }
    FailsAgain { "同一步骤一再失败", "单元已保持，不再自行重试。", ["阅读最后的回答：它说明哪里不行。", "查看设备、其程序和线路。", "按 RESUME 重试，或结束运行。"] }
    ProgramRestarted { "程序在运行中途重新启动", "单元保持；询问设备其任务的结果，运动中的被保持。", ["查看两台设备：状态说明了哪些已查明、哪些没有。", "按 RESUME：单元从该处继续。"] }
    NotClear { "设备没有离开工件", "另一台设备不启动。", ["在其面板上将它移到停放位置。", "按 RESUME。"] }
    Coverage { "工件被测量的部分太少", "本次测量不予使用。", ["检查工件上是否有冷却液、切屑或压板，测针是否磨损或弯曲。", "按 RESUME 重新测量。"] }
    NoPart { "在应有的位置没有找到工件", "本次测量不予使用。", ["确认工件已装夹，且是正确的工件。", "按 RESUME 重新测量，或结束运行。"] }
    PartMisplaced { "工件偏离预期位置超过配方允许", "不生成误差图：否则会磨在错误的位置。", ["查看工件的装夹：转向、下有切屑、在别的座上。", "结束运行，按图装夹工件，开始以测量为起点的运行。", "如果它一直放置正确，按 RESUME 重新测量。"] }
    PartMoved { "工件已不在本次测量首次触测时的位置", "重复触测的点不予使用：它们属于工件的另一位置。", ["检查工件是否夹紧、是否有人移动过它。", "等待工件和室温稳定。", "按 RESUME 重新测量整个工件。"] }
    ProbeRadius { "测头半径与配方不符", "本次测量不予使用：每个偏差都会因此出错。", ["清洁测球和标准球。", "在设备上校准测头，或换上正确的测针。", "按 RESUME 重新测量；半径不同的配方需要新的运行。"] }
    Contacts { "设备给出的是接触点，而应为测球中心", "本次测量不予使用：会有一个测头半径的误差。", ["关闭测量程序的半径补偿。", "按 RESUME 重新测量。"] }
    ForeignResult { "结果属于另一个工件、方案或循环", "不予使用。", ["查看设备执行了哪个任务。", "按 RESUME 重新测量。"] }
    BrokenResult { "结果已损坏", "不予使用。", ["阅读其中哪一项不可能：不可能的数值或点来自测头或测量程序，点数不符来自其目标列表。", "更正后按 RESUME 重新测量。"] }
    Temperature { "测量期间温度超出允许范围", "本次测量不予使用。", ["等待工件和室温稳定。", "按 RESUME 重新测量。"] }
    RegistrationFailed { "测量无法与名义面配准", "本次测量不予使用。", ["确认工件与配方中的名义面相符。", "查看运行文件夹中本循环的点。", "按 RESUME 重新测量，或结束运行。"] }
    ComputationLate { "计算超时", "单元在其之前保持。", ["查看计算机是否过载。", "按 RESUME 重新计算。"] }
    WeakDirections { "该面无法确定修正会磨在工件的何处", "不作修正。本循环的误差图在运行文件夹中。", ["如果夹具或基准点足以固定所列方向，请在配方中固定它们 (registration.lock)。", "或测量能固定它们的特征：边缘、基准标记、更大的孔径。", "开始以测量为起点的新运行。"] }
    CompensationFailed { "没有用于下一次磨削的误差图", "不再磨削。", ["阅读原因和本循环的数值。", "按 RESUME 重新计算，或结束运行。"] }
    ParameterBeyond { "设备的一个参数偏差超出配方给定的公差", "在有人同意之前不会开始下一遍：将按修正后的参数磨削。", ["用其他方法测量：用轮廓或触碰基准测砂轮半径，用千分表测砂轮位置和工件姿态。", "若属实，按 RESUME：下一遍按该参数磨削，补偿图只含剩余部分。", "若不属实，停止运行，改正配方或设备后开始新的运行；compensation.parameters 中没有该键时，全部进入补偿图。"] }
    SignFlipped { "工件对误差图的响应方向相反", "再磨一次会更差；单元保持。", ["检查磨床上误差图的符号：正值留下材料。", "在废件上试磨证明符号正确之前不要按 RESUME。", "结束运行。"] }
    Mirrored { "工件的响应如同误差图被镜像或旋转", "再磨一次会更差；单元保持。", ["检查磨床上 x 和 y 的方向，以及工件在夹具中的转向。", "在废件上试磨证明方向正确之前不要按 RESUME。", "结束运行。"] }
    Doubled { "工件的响应如同误差图被应用了两次", "再磨一次会偏向另一侧；单元保持。", ["查看误差图是否既在程序中又在控制器的表中，或被加到了上一个上：它是绝对值。", "在只有一处应用之前不要按 RESUME。", "结束运行。"] }
    NoEffect { "工件对误差图没有响应", "再磨一次不会有变化；单元保持。", ["查看砂轮是否触及工件，磨床是否使用了误差图。", "检查砂轮半径和工件零点。", "按 RESUME 再磨一次，或结束运行。"] }
    Diverging { "工件正在变差", "第二个更差的循环之后，按配方处理：保持或结束。", ["比较最近几个循环的误差图。", "检查砂轮磨损、夹紧松动、温度变化。", "如对下一次磨削有疑问，请保持运行。"] }
    Stalled { "工件不再变好", "按配方处理：保持或结束。", ["将剩余误差与测量不确定度和磨床的重复性比较。", "按 RESUME 再磨一次，或结束运行。"] }
    Undecided { "测量既不能证明工件合格，也不能证明不合格", "按配方处理：保持或结束。", ["用更多的点或更小的噪声测量：更小的不确定度才能判定。", "再磨一次会去除材料，且预计没有帮助。"] }
    LeftOut { "有测点因与相邻测点不一致而被排除，计入它们后工件超出限值", "不接受该工件：已测到的都算数，直到重新测量。", ["查看并清洁所列位置和测头，不要移动工件。", "按 RESUME 重新测量这些位置及其周围；无法单独测量时将重新测量整个工件。", "如果再次列出相同位置，则缺陷在工件上：结束运行，由质量部门决定。"] }
    MaxCycles { "配方不允许再次磨削", "运行结束，未达到公差。", ["查看各循环的数值。", "如果数值仍在下降，请在配方中允许更多次数，并开始以测量为起点的运行。"] }
    BudgetSpent { "允许去除的材料已用完", "不再磨削；运行结束，未达到公差。", ["由质量部门决定该工件：已磨去的无法恢复。", "下一个工件请留更多余量。"] }
    JournalUnwritable { "无法写入运行记录", "不开始新的动作：没有记录的就不做。", ["检查运行文件夹：权限、网络驱动器、磁盘。", "按 RESUME。"] }
    DiskFull { "磁盘已满", "不开始新的动作：没有记录的就不做。", ["释放运行文件夹所在磁盘的空间。", "按 RESUME。"] }
    ControlLost { "指令到达单元的通道被移走", "运行继续，通道会重新建立。在运行终端按一次 Ctrl-C 保持，两次中止。", ["查明谁在删除或移动运行文件夹中的文件。", "`regrind status` 显示指令是否又能到达。", "如果不能，保持运行。"] }
    HoldNotConfirmed { "设备未确认已保持", "已要求两台设备按各自的安全流程结束。", ["查看设备。", "如果仍在运动，请使用设备自身的急停回路。"] }
    StopNotConfirmed { "停止未确认：设备没有报告已静止", "它可能仍在运动。", ["使用设备自身的急停回路。", "在看到设备静止之前不要靠近。", "然后查明它为何不应答。"] }
    WaitedTooLong { "无人及时应答", "运行有序结束。", ["消除保持的原因，并开始以测量为起点的运行。"] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use regrind_cell::Role;

    #[test]
    fn alarms_translated_in_every_language() {
        for &id in AlarmId::ALL {
            let remedy = id.remedy().iter().map(|line| (*line).to_owned()).collect::<Vec<_>>();
            let event = format!("{}: grinder at 12 mm.", id.head());
            let alarm = Alarm { id, event, consequence: "c".to_owned(), remedy, cleared_by: Role::Operator };
            for language in [Language::De, Language::Zh] {
                let said = alarm_texts(&alarm, language);
                assert!(said.event.ends_with(": grinder at 12 mm."), "{id:?}: {}", said.event);
                assert!(!said.event.starts_with(id.head()), "{id:?} is not translated");
                assert_eq!(said.remedy.len(), alarm.remedy.len(), "{id:?} in {language:?}");
            }
            assert_eq!(alarm_texts(&alarm, Language::En).event, alarm.event);
            let older = id.head().replace(|letter: char| letter.is_alphabetic(), "#");
            let older = Alarm { event: format!("{older}: grinder at 12 mm."), ..alarm };
            assert!(
                alarm_texts(&older, Language::De).event.ends_with(": grinder at 12 mm."),
                "{id:?}: its older wording"
            );
            assert!(!alarm_texts(&older, Language::De).event.contains('#'), "{id:?}: its older wording");
        }
    }
}
