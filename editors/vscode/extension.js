// Starts `powderdsl lsp` for files whose first key is one of powderdsl's.
const vscode = require("vscode");
const { LanguageClient } = require("vscode-languageclient/node");

const OURS = /^(pack|ruleset|task|study|scenes?):/m;
const HEAD = 4000;
let client;

/** Makes YAML files of powderdsl files of its language; others stay YAML. */
function adopt(document) {
  if (document.languageId !== "yaml" || !OURS.test(document.getText().slice(0, HEAD))) return;
  vscode.languages.setTextDocumentLanguage(document, "powderdsl");
}

exports.activate = (context) => {
  const settings = vscode.workspace.getConfiguration("powderdsl");
  const beside = settings.get("with");
  const args = ["lsp", ...(beside ? ["--with", beside] : [])];
  const command = settings.get("command");
  client = new LanguageClient("powderdsl", "powderdsl", { command, args }, { documentSelector: [{ language: "powderdsl" }] });
  context.subscriptions.push(vscode.workspace.onDidOpenTextDocument(adopt));
  vscode.workspace.textDocuments.forEach(adopt);
  return client.start();
};

exports.deactivate = () => client?.stop();
