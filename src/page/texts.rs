//! Texts of the page in all its languages. The texts of alarms are in a separate file. Messages of a cell about its
//! machines stay in the wording of the cell.

use regrind_cell::{Device, JobStep, Phase, StateName};
use regrind_control::NextStep;
use regrind_report::RunResult;

use super::users::PageRole;

/// Language of the page.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) enum Language {
    #[default]
    En,
    De,
    Zh,
}

impl Language {
    pub(crate) const ALL: [Self; 3] = [Self::En, Self::De, Self::Zh];

    /// Returns the language tag for HTML and browsers, such as `en`.
    pub(crate) fn tag(self) -> &'static str {
        ["en", "de", "zh"][self as usize]
    }

    /// Returns the name of the language in the language itself.
    pub(crate) fn name(self) -> &'static str {
        ["English", "Deutsch", "中文"][self as usize]
    }

    /// Returns the first language in `tags` that the page supports. `tags` is a list separated by commas, such as the
    /// value of the header `Accept-Language`. The order of the list decides; weights such as `q=0.5` are ignored.
    /// Returns `None` if the page supports none of the languages.
    pub(crate) fn first_of(tags: &str) -> Option<Self> {
        tags.split(',').find_map(|tag| {
            let primary = tag.trim().split(['-', ';', '_']).next()?.to_ascii_lowercase();
            Self::ALL.into_iter().find(|language| language.tag() == primary)
        })
    }
}

/// Formats a number with the given number of decimals, and with the decimal sign of `language`.
pub(crate) fn decimal(value: f64, digits: usize, language: Language) -> String {
    let text = format!("{value:.digits$}");
    if language == Language::De { text.replacen('.', ",", 1) } else { text }
}

/// Formats a number with all its decimals, and with the decimal sign of `language`.
pub(crate) fn shortest(value: f64, language: Language) -> String {
    let text = value.to_string();
    if language == Language::De { text.replacen('.', ",", 1) } else { text }
}

macro_rules! texts {
    ($($name:ident { $en:literal, $de:literal, $zh:literal })+) => {
        /// Text of the page.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) enum Text {
            $($name,)+
        }

        impl Text {
            #[cfg(test)]
            const ALL: &[Self] = &[$(Self::$name),+];

            /// Returns this text in `language`.
            pub(crate) fn to(self, language: Language) -> &'static str {
                match self {
                    $(Self::$name => [$en, $de, $zh][language as usize],)+
                }
            }
        }
    };
}

texts! {
    // The frame of the page.
    Cell { "Cell", "Zelle", "单元" }
    Runs { "Runs", "Läufe", "运行记录" }
    Compare { "Compare", "Vergleichen", "比较" }
    Language { "Language", "Sprache", "语言" }
    Appearance { "Appearance", "Darstellung", "外观" }
    AsTheSystem { "as the system", "wie das System", "跟随系统" }
    Light { "light", "hell", "浅色" }
    Dark { "dark", "dunkel", "深色" }
    HighContrast { "high contrast", "hoher Kontrast", "高对比度" }
    SkipToOrders { "To the orders", "Zu den Befehlen", "跳到指令" }
    Simulation { "SIMULATION", "SIMULATION", "仿真" }
    NotConnected { "No data since", "Keine Daten seit", "无数据，自" }
    ProgramGone {
        "The program that ran the cell does not answer. The state of the machines is unknown: go to the machines and check their state. Then run: regrind resume",
        "Das Programm der Zelle antwortet nicht. Was die Maschinen tun, ist nicht bekannt: bitte nachsehen. Dann: regrind resume",
        "单元程序没有应答。机器的状态未知：请到现场查看。然后执行：regrind resume"
    }
    SimulationGone {
        "The program that simulated this cell has ended. The simulated machines have ended too. Begin a new run.",
        "Das Programm, das diese Zelle simuliert hat, ist beendet, und mit ihm ihre Maschinen. Bitte einen neuen Lauf beginnen.",
        "仿真该单元的程序已结束，其中的机器也随之结束。请开始新的运行。"
    }
    PageGone {
        "This page has lost the connection to its server and cannot show the state of the cell. Go to the machines and check their state.",
        "Diese Seite hat ihren Server verloren. Was die Zelle tut, ist hier nicht bekannt: bitte nachsehen.",
        "页面与服务器断开。此处无法得知单元状态：请到现场查看。"
    }
    // Texts about the part.
    Part { "Part", "Teil", "零件" }
    Recipe { "Recipe", "Rezept", "配方" }
    Cycle { "Cycle", "Zyklus", "循环" }
    OfAtMost { "of at most", "von höchstens", "／最多" }
    Operator { "Operator", "Bediener", "操作员" }
    Run { "Run", "Lauf", "运行" }
    Began { "Began", "Beginn", "开始" }
    Ended { "Ended", "Ende", "结束" }
    Since { "Since", "Seit", "自" }
    Until { "Until", "Bis", "至" }
    Result { "Result", "Ergebnis", "结果" }
    Alarms { "Alarms", "Alarme", "报警" }
    // Steps of a cycle.
    LoadStep { "Load", "Laden", "装件" }
    GrindStep { "Grind", "Schleifen", "磨削" }
    MeasureStep { "Measure", "Messen", "测量" }
    RegisterStep { "Register", "Einpassen", "配准" }
    JudgeStep { "Judge", "Beurteilen", "判定" }
    CorrectStep { "Correct", "Korrigieren", "补偿" }
    StepsOfCycle { "Steps of the cycle", "Schritte des Zyklus", "循环步骤" }
    ToEndOfStep { "to the end of this step", "bis zum Ende dieses Schritts", "距本步骤结束" }
    HeldBy { "Held by", "Angehalten von", "保持人：" }
    ReasonOfHold { "Reason of the hold", "Grund des Anhaltens", "保持的原因" }
    StateReason { "RECORD THE REASON", "GRUND FESTHALTEN", "记录原因" }
    Answer { "Answer to the last order", "Antwort auf den letzten Befehl", "对上一指令的应答" }
    // Column with the current work.
    NextAction { "Your next action", "Ihr nächster Schritt", "您的下一步" }
    PreliminaryPoints { "preliminary", "vorläufig", "初步" }
    PreliminaryMeans {
        "deviations relative to the planned position of the part, before the registration and before the judgement",
        "gegen die Lage des Teils im Plan; nicht eingepasst, nicht beurteilt",
        "相对于计划中的工件位置；未配准，未判定"
    }
    Waits { "Waiting for", "Wartet auf", "等待" }
    WhatToDo { "What to do", "Was zu tun ist", "处理方法" }
    ClearedBy { "Cleared by", "Quittiert durch", "复位人" }
    ByItself { "nobody: the alarm ends by itself", "niemand: er geht von selbst", "无需：自行消失" }
    ByOperator { "the operator", "den Bediener", "操作员" }
    ByEngineer { "the process engineer", "den Prozessingenieur", "工艺工程师" }
    NoAlarm { "No alarm", "Kein Alarm", "无报警" }
    NoAlarmRaised { "No alarm was raised", "Kein Alarm wurde ausgelöst", "未触发过报警" }
    Raised { "raised", "ausgelöst", "触发于" }
    Withdrawn { "gone", "behoben", "消除于" }
    StoodAtTheEnd { "active at the end", "stand am Ende noch an", "结束时仍存在" }
    // Figures.
    Convergence { "Convergence", "Konvergenz", "收敛" }
    LastJudged { "Last judged", "Zuletzt beurteilt", "最近判定" }
    Cycles { "Cycles", "Zyklen", "各循环" }
    ThisRun { "This run", "Dieser Lauf", "本次运行" }
    UncertaintyOfGauge {
        "± and the dark band: expanded uncertainty, k = 2",
        "± und dunkles Band: erweiterte Unsicherheit, k = 2",
        "± 和深色带：扩展不确定度 k = 2"
    }
    LeftOut { "Left out as outliers", "Als Ausreißer weggelassen", "作为离群点被排除" }
    Judged { "judged", "beurteilt", "判定" }
    Limit { "limit", "Grenze", "限值" }
    Forecast { "forecast", "Prognose", "预测" }
    NotMeasured { "nothing is measured yet", "noch nichts gemessen", "尚未测量" }
    Uncertainty { "expanded uncertainty, k = 2", "erweiterte Unsicherheit, k = 2", "扩展不确定度 k = 2" }
    Report { "Report", "Bericht", "报告" }
    // The map.
    Map { "Error map", "Fehlerkarte", "误差图" }
    Relief { "Relief", "Relief", "立体图" }
    Difference { "Change", "Änderung", "变化" }
    DifferenceOfRuns { "Difference of the maps", "Differenz der Karten", "误差图之差" }
    Sigma { "Uncertainty", "Unsicherheit", "不确定度" }
    Points { "Points", "Punkte", "测点" }
    Scale { "Scale", "Skala", "色标" }
    ScaleOfFirst { "first cycle", "erster Zyklus", "首个循环" }
    ScaleOfMap { "this map", "diese Karte", "本图" }
    ScaleOfTolerance { "tolerance", "Toleranz", "公差" }
    SignOfMap { "red: too high, blue: too low", "rot: zu hoch, blau: zu tief", "红色偏高，蓝色偏低" }
    NoCycleBefore { "there is no map of the cycle before", "keine Karte des Zyklus davor", "没有上一循环的误差图" }
    PreliminaryDots {
        "preliminary, without height and tilt",
        "vorläufig, ohne Höhe und Neigung",
        "初步，已去除高度和倾斜"
    }
    HeightFactor { "heights drawn", "Höhen überhöht", "高度放大" }
    Sections { "Sections along x and y", "Schnitte längs x und y", "沿 x 和 y 的截面" }
    SectionHelp {
        "click the map for two sections",
        "Karte anklicken für zwei Schnitte",
        "点击误差图显示两个截面"
    }
    SaveMap { "Save the map", "Karte speichern", "保存误差图" }
    Deviations { "Deviations (CSV)", "Abweichungen (CSV)", "偏差（CSV）" }
    Histogram { "Distribution", "Verteilung", "分布" }
    NoRelief {
        "This browser cannot draw the relief (3D view). The page shows the error map instead.",
        "Dieser Browser zeichnet kein Relief: die Karte wird gezeigt.",
        "此浏览器无法绘制立体图：显示误差图。"
    }
    MapHelp {
        "Error of the part along the normal, in micrometres. In the map, the arrow keys move the mark. In the relief, the arrow keys turn the view.",
        "Fehler des Teils längs der Normalen, in Mikrometern. Pfeiltasten bewegen die Marke oder drehen das Relief.",
        "零件沿法向的误差，单位微米。方向键移动标记或旋转立体图。"
    }
    KnownTo { "Standard uncertainty of the map, RMS:", "Standardunsicherheit der Karte, RMS:", "误差图的标准不确定度，RMS：" }
    Filtered { "Filtered map (not judged):", "Der gefilterten Karte:", "滤波后的图：" }
    Planned { "planned", "geplant", "计划" }
    Touched { "touched", "angetastet", "已测" }
    // Orders.
    Hold { "HOLD", "HALTEN", "保持" }
    Resume { "RESUME", "FORTSETZEN", "继续" }
    Stop { "END THE RUN", "LAUF BEENDEN", "结束运行" }
    Abort { "ABORT", "ABBRECHEN", "中止" }
    Loaded { "THE PART IS LOADED", "TEIL IST GELADEN", "零件已装好" }
    IsClear { "IS CLEAR OF THE PART", "IST FREI VOM TEIL", "已离开零件" }
    DeclareOver { "ITS JOB IS OVER", "AUFTRAG IST BEENDET", "作业已结束" }
    WhatYouSaw { "What you saw at the machine", "Was an der Maschine zu sehen war", "您在机器上看到的情况" }
    FirstThing { "RESUME does this first:", "FORTSETZEN tut zuerst dies:", "“继续”首先执行：" }
    TakeControl { "TAKE CONTROL", "BEDIENUNG ÜBERNEHMEN", "接管操作" }
    ControlElsewhere {
        "Another screen has control of the cell. The buttons HOLD, END THE RUN and ABORT work on this screen too.",
        "Ein anderer Bildschirm bedient. Halten, Beenden und Abbrechen gehen hier trotzdem.",
        "另一屏幕正在操作。此处仍可保持、结束和中止。"
    }
    NoButtonStops {
        "No button here replaces the emergency stop of the machine.",
        "Kein Knopf hier ersetzt den Not-Halt der Maschine.",
        "此处任何按钮都不能代替机器的急停。"
    }
    // Steps of a person at a machine.
    StepMeasure { "measure the part", "Teil messen", "测量零件" }
    StepMoveProbeClear { "move the probe clear of the part", "Taster vom Teil wegfahren", "将测头移离零件" }
    StepBeginPass { "grind the part", "Teil schleifen", "磨削零件" }
    StepEndPass { "the pass runs", "der Durchgang läuft", "磨削进行中" }
    StepHold { "hold the machine at its own panel", "Maschine an ihrem Bedienfeld anhalten", "在机床面板上暂停机床" }
    StepStop { "stop the machine at its own panel", "Maschine an ihrem Bedienfeld beenden", "在机床面板上停止机床" }
    StepAbort {
        "stop the machine at its own panel NOW; Regrind cannot stop it",
        "Maschine SOFORT an ihrem Bedienfeld stoppen; Regrind kann es nicht",
        "立即在机床面板上停机；Regrind 无法停止它"
    }
    CheckFirst { "Check before:", "Vorher prüfen:", "事先检查：" }
    RightPartClean { "the right part, clean and clamped", "das richtige Teil, sauber und gespannt", "零件正确、清洁且已夹紧" }
    RightPartClamped { "the right part, clamped", "das richtige Teil, gespannt", "零件正确且已夹紧" }
    WheelIsClear { "the wheel is clear of the part", "die Scheibe ist frei vom Teil", "砂轮已离开零件" }
    ProbeIsClear { "the probe is clear of the part", "der Taster ist frei vom Teil", "测头已离开零件" }
    ProbeFits { "the probe is the one of the plan", "der Taster ist der des Plans", "测头与计划一致" }
    WheelFits { "wheel and feed are as above", "Scheibe und Vorschub sind wie oben", "砂轮和进给与上述一致" }
    RequiredPoints { "Points", "Punkte", "测点" }
    AtLeast { "at least", "mindestens", "至少" }
    PlanDigits { "Plan", "Plan", "计划" }
    ProbeRadius { "Probe radius", "Tasterradius", "测头半径" }
    Program { "Program", "Programm", "程序" }
    OwnProgram { "your own program", "Ihr eigenes Programm", "您自己的程序" }
    MapDigits { "Correction map", "Korrekturkarte", "补偿图" }
    WheelRadius { "Wheel radius", "Scheibenradius", "砂轮半径" }
    Feed { "Feed", "Vorschub", "进给" }
    SparkOutPasses { "Spark-out passes", "Ausfunkdurchgänge", "光磨次数" }
    WhenMeasured {
        "When the part is measured and the probe is clear of the part:",
        "Wenn das Teil gemessen und der Taster frei ist:",
        "测量完成且测头离开零件后："
    }
    WhenProbeClear { "When the probe is clear of the part:", "Wenn der Taster frei vom Teil ist:", "测头离开零件后：" }
    WhenPassBegun { "Begin the pass at the machine. Then:", "Den Durchgang an der Maschine beginnen. Dann:", "在机床上开始磨削。然后：" }
    WhenPassEnded {
        "When the pass has ended and the wheel is clear of the part:",
        "Wenn der Durchgang zu Ende und die Scheibe frei ist:",
        "磨削结束且砂轮离开零件后："
    }
    WhenAtRest { "When the machine is at rest:", "Wenn die Maschine steht:", "机床静止后：" }
    PassHasBegun { "THE PASS HAS BEGUN", "DURCHGANG HAT BEGONNEN", "磨削已开始" }
    JobIsDone { "DONE, AND CLEAR OF THE PART", "FERTIG UND FREI VOM TEIL", "完成，且已离开零件" }
    IsAtRest { "THE MACHINE IS AT REST", "DIE MASCHINE STEHT", "机床已静止" }
    MeasurementFile { "File of the measurement", "Datei der Messung", "测量文件" }
    SendMeasurement { "SEND THE MEASUREMENT", "MESSUNG SENDEN", "发送测量结果" }
    // Next actions.
    DoStep { "Do what this machine asks for:", "Tun, was diese Maschine verlangt:", "按此机床的要求操作：" }
    Nothing { "No action needed.", "Nichts: die Zelle arbeitet selbst.", "无：单元自动运行。" }
    Load {
        "Load the part and clamp it. Check that the wheel and the probe are clear of the part. Then press THE PART IS LOADED.",
        "Teil laden und spannen. Prüfen, dass Scheibe und Taster frei sind. Dann TEIL IST GELADEN drücken.",
        "装上零件并夹紧。确认砂轮和测头已离开零件。然后按“零件已装好”。"
    }
    SeeClear {
        "Check that the machine at the end of this text is clear of the part. Then press the button below. Name of the machine:",
        "Prüfen, dass diese Maschine frei vom Teil ist, und bestätigen:",
        "确认此机器已离开零件："
    }
    SeeToAlarm {
        "Follow the steps of the alarm. The cell continues by itself when the alarm is cleared.",
        "Tun, was der Alarm sagt. Die Zelle macht selbst weiter, wenn er weg ist.",
        "按报警提示处理。报警消失后单元自动继续。"
    }
    ClearAlarm {
        "Follow the steps of the alarm. Then press RESUME or END THE RUN.",
        "Tun, was der Alarm sagt. Dann FORTSETZEN drücken oder LAUF BEENDEN.",
        "按报警提示处理。然后按“继续”或“结束运行”。"
    }
    ResumeOrStop {
        "Press RESUME to continue, or END THE RUN.",
        "FORTSETZEN drücken, oder LAUF BEENDEN.",
        "按“继续”，或“结束运行”。"
    }
    SeeStands {
        "Check that the machine at the end of this text is at rest. Then press RESUME. The cell then asks the machine for the state of the job. If the machine cannot report this state, write what you saw at the machine in the field below. Then press ITS JOB IS OVER. Name of the machine:",
        "Prüfen, ob diese Maschine steht. Dann FORTSETZEN drücken: sie wird nach ihrem Auftrag gefragt; kann sie es nicht sagen, unten angeben:",
        "查看此机器是否静止。然后按“继续”，系统会询问其作业结果；若机器无法应答，请在下方说明："
    }
    KeepAway {
        "Keep away from both machines: they execute their safe sequence.",
        "Abstand halten von beiden Maschinen: sie fahren ihre sichere Folge.",
        "远离两台机器：正在执行安全动作。"
    }
    EmergencyCircuit {
        "Use the emergency stop of each machine that did not confirm that it is at rest.",
        "Not-Halt jeder Maschine betätigen, die ihren Stillstand nicht bestätigt hat.",
        "对未确认静止的机器使用急停。"
    }
    ReadReport { "The run is over. Read the report of this run.", "Der Lauf ist zu Ende: Bericht lesen.", "运行已结束：请看报告。" }
    // States, by PackML's names.
    Idle { "IDLE", "BEREIT", "待机" }
    Starting { "STARTING", "STARTET", "启动中" }
    Execute { "EXECUTE", "LÄUFT", "运行中" }
    Holding { "HOLDING", "HÄLT AN", "保持中" }
    Held { "HELD", "ANGEHALTEN", "已保持" }
    Unholding { "UNHOLDING", "SETZT FORT", "恢复中" }
    Suspending { "SUSPENDING", "SETZT AUS", "暂停中" }
    Suspended { "SUSPENDED", "AUSGESETZT", "已暂停" }
    Unsuspending { "UNSUSPENDING", "MACHT WEITER", "恢复中" }
    Stopping { "STOPPING", "BEENDET", "停止中" }
    Stopped { "STOPPED", "BEENDET", "已停止" }
    Aborting { "ABORTING", "BRICHT AB", "中止中" }
    Aborted { "ABORTED", "ABGEBROCHEN", "已中止" }
    Completing { "COMPLETING", "SCHLIESST AB", "完成中" }
    Complete { "COMPLETE", "FERTIG", "完成" }
    // Phases.
    AtLoad { "loading", "Laden", "装件" }
    AtGrind { "grinding", "Schleifen", "磨削" }
    AtTransfer { "leaving the part to the CMM", "Übergabe an die Messmaschine", "移交测量机" }
    AtMeasure { "measuring", "Messen", "测量" }
    AtRegister { "registering", "Einpassen", "配准" }
    AtJudge { "judging", "Beurteilen", "判定" }
    AtCompensate { "computing the correction", "Korrektur berechnen", "计算补偿" }
    // First action of a resume.
    GoesOn {
        "the machine continues its job from its present position",
        "die Maschine setzt ihren Auftrag dort fort, wo sie steht",
        "机器从当前位置继续作业"
    }
    Asks {
        "the cell asks the machine for the state of its job; nothing moves before the machine has answered",
        "die Maschine wird nach ihrem Auftrag gefragt; nichts bewegt sich vor ihrer Antwort",
        "询问机器作业结果；应答前不会有任何动作"
    }
    SendsAnew {
        "the job is sent to the machine again and checked; then the machine starts",
        "der Auftrag wird der Maschine neu gesendet und geprüft; dann startet sie",
        "重新发送并检查作业；然后启动"
    }
    ReadsResult {
        "the result is read from the machine again",
        "das Ergebnis wird noch einmal von der Maschine gelesen",
        "重新读取机器结果"
    }
    GivesBack {
        "the cell permits the machine to delete the result of the job",
        "der Maschine wird gesagt, dass sie ihr Ergebnis vergessen darf",
        "告知机器可以清除结果"
    }
    AsksToLoad { "the cell asks for the part", "nach dem Teil wird gefragt", "要求装件" }
    LeavesPart {
        "the cell checks that the grinder is clear of the part; then the measurement begins",
        "geprüft wird, dass die Schleifmaschine frei ist; dann beginnt die Messung",
        "确认磨床已离开零件；然后开始测量"
    }
    ComputesAnew { "the cell repeats the computation; nothing moves", "es wird neu berechnet; nichts bewegt sich", "重新计算；无动作" }
    // Results of runs.
    Open { "no end on record", "kein Ende im Protokoll", "无结束记录" }
    Live { "on now", "im Gang", "进行中" }
    Accepted { "ACCEPTED", "ANGENOMMEN", "合格" }
    NotAccepted { "NOT ACCEPTED", "NICHT ANGENOMMEN", "不合格" }
    WasStopped { "STOPPED", "BEENDET", "已停止" }
    WasAborted { "ABORTED", "ABGEBROCHEN", "已中止" }
    Recovery { "machines brought home", "Maschinen heimgefahren", "机器复位" }
    All { "all", "alle", "全部" }
    Show { "Show", "Anzeigen", "显示" }
    TwoSideBySide {
        "Choose two runs, then compare them side by side.",
        "Zwei Läufe wählen, dann nebeneinander vergleichen.",
        "选择两次运行并排比较。"
    }
    KeyNeeded {
        "This page needs its key. Open the full address that `regrind serve` printed: this address contains the key.",
        "Diese Seite braucht ihren Schlüssel. Er steht in der Adresse, die `regrind serve` ausgegeben hat.",
        "此页面需要密钥，见 `regrind serve` 输出的地址。"
    }
    // Signing in.
    SignIn { "Sign in", "Anmelden", "登录" }
    SignOut { "Sign out", "Abmelden", "退出" }
    UserName { "Name", "Name", "用户名" }
    Password { "Password", "Kennwort", "密码" }
    SignInRefused {
        "The name or the password is wrong. Type both again.",
        "Name und Kennwort gehören nicht zusammen. Beide noch einmal eingeben.",
        "用户名与密码不符。请重新输入。"
    }
    TooManyTries {
        "Too many attempts from this address. Wait one minute, then sign in again.",
        "Zu viele Versuche von hier. Eine Minute warten, dann anmelden.",
        "此处尝试次数过多。请等待一分钟再登录。"
    }
    WhoMakesUsers {
        "To add a user, the administrator of the cell computer runs: regrind users add",
        "Wer den Rechner der Zelle betreut, legt Benutzer an: regrind users add",
        "由单元计算机的管理者添加用户：regrind users add"
    }
    Viewer { "viewer", "Betrachter", "查看者" }
    Quality { "quality", "Qualität", "质量" }
    OperatorRole { "operator", "Bediener", "操作员" }
    Engineer { "engineer", "Ingenieur", "工程师" }
    NotHere { "There is nothing at this address.", "Unter dieser Adresse ist nichts.", "此地址没有内容。" }
}

/// Returns the word for a state of the cell.
pub(crate) fn state(name: StateName) -> Text {
    match name {
        StateName::Idle => Text::Idle,
        StateName::Starting => Text::Starting,
        StateName::Execute => Text::Execute,
        StateName::Holding => Text::Holding,
        StateName::Held => Text::Held,
        StateName::Unholding => Text::Unholding,
        StateName::Suspending => Text::Suspending,
        StateName::Suspended => Text::Suspended,
        StateName::Unsuspending => Text::Unsuspending,
        StateName::Stopping => Text::Stopping,
        StateName::Stopped => Text::Stopped,
        StateName::Aborting => Text::Aborting,
        StateName::Aborted => Text::Aborted,
        StateName::Completing => Text::Completing,
        StateName::Complete => Text::Complete,
    }
}

/// Returns the words for a phase of a run.
pub(crate) fn phase(phase: Phase) -> Text {
    match phase {
        Phase::Load => Text::AtLoad,
        Phase::Grind(_) => Text::AtGrind,
        Phase::Transfer => Text::AtTransfer,
        Phase::Measure(_) => Text::AtMeasure,
        Phase::Register => Text::AtRegister,
        Phase::Judge => Text::AtJudge,
        Phase::Compensate => Text::AtCompensate,
    }
}

/// Returns the words for the result of a run.
pub(crate) fn result(result: RunResult) -> Text {
    match result {
        RunResult::Open => Text::Open,
        RunResult::Accepted => Text::Accepted,
        RunResult::NotAccepted => Text::NotAccepted,
        RunResult::Stopped => Text::WasStopped,
        RunResult::Aborted => Text::WasAborted,
        RunResult::Recovery => Text::Recovery,
    }
}

/// Returns the word for a role of a person.
pub(crate) fn role(role: PageRole) -> Text {
    match role {
        PageRole::Viewer => Text::Viewer,
        PageRole::Quality => Text::Quality,
        PageRole::Operator => Text::OperatorRole,
        PageRole::Engineer => Text::Engineer,
    }
}

/// Returns the sentence for what a person must do next, and the machine that this concerns, if any.
pub(crate) fn next(next: &NextStep, language: Language) -> (String, Option<Device>) {
    let (text, device) = match next {
        NextStep::Load => (Text::Load, None),
        NextStep::SeeClear { device } => (Text::SeeClear, Some(*device)),
        NextStep::AtMachine { device } => (Text::DoStep, Some(*device)),
        NextStep::Bring { what } => return (what.clone(), None),
        NextStep::SeeToAlarm => (Text::SeeToAlarm, None),
        NextStep::ClearAlarm => (Text::ClearAlarm, None),
        NextStep::ResumeOrStop => (Text::ResumeOrStop, None),
        NextStep::SeeWhetherItStands { device } => (Text::SeeStands, Some(*device)),
        NextStep::KeepAway => (Text::KeepAway, None),
        NextStep::EmergencyCircuit => (Text::EmergencyCircuit, None),
        NextStep::ReadReport => (Text::ReadReport, None),
        _ => (Text::Nothing, None),
    };
    (text.to(language).to_owned(), device)
}

/// Returns the sentence that tells what the cell does first when a run that is held in `phase` is resumed. Also returns
/// the machine that the sentence concerns, if there is one.
pub(crate) fn on_resume(phase: Phase) -> (Text, Option<Device>) {
    let Some((device, step)) = phase.job() else {
        let text = match phase {
            Phase::Load => Text::AsksToLoad,
            Phase::Transfer => Text::LeavesPart,
            _ => Text::ComputesAnew,
        };
        return (text, None);
    };
    let text = match step {
        JobStep::Run => Text::GoesOn,
        JobStep::Reconcile => Text::Asks,
        JobStep::Send | JobStep::Clear | JobStep::Prepare | JobStep::Start => Text::SendsAnew,
        JobStep::Collect | JobStep::Qualify => Text::ReadsResult,
        JobStep::Acknowledge | JobStep::Discard => Text::GivesBack,
    };
    (text, Some(device))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_exist_in_every_language() {
        for text in Text::ALL {
            for language in Language::ALL {
                assert!(!text.to(language).trim().is_empty(), "{text:?} in {language:?}");
            }
        }
    }

    #[test]
    fn first_of_accept_language() {
        for (tags, expected) in [
            ("de-DE,de;q=0.9,en;q=0.8", Some(Language::De)),
            ("fr, zh-Hans-CN;q=0.8", Some(Language::Zh)),
            ("EN_us", Some(Language::En)),
            ("fr", None),
            ("", None),
            (";;,,-", None),
        ] {
            assert_eq!(Language::first_of(tags), expected, "{tags}");
        }
    }

    #[test]
    fn no_button_is_called_emergency_stop() {
        let buttons =
            [Text::Hold, Text::Resume, Text::Stop, Text::Abort, Text::Loaded, Text::IsClear, Text::DeclareOver];
        for text in buttons {
            for language in Language::ALL {
                let word = text.to(language).to_lowercase();
                for bad in ["emergency", "not-halt", "notaus", "急停"] {
                    assert!(!word.contains(bad), "{word}");
                }
            }
        }
    }
}
